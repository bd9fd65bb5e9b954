__all__ = ["Alternative", "Drive", "Localization", "Located", "Map", "Prediction", "Route"]

from .map import Map
from .predictions import Alternative, Localization, Located, Prediction
from .route import Drive, Route
