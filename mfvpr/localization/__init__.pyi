__all__ = ["Alternative", "Drive", "Localization", "Located", "Map", "Prediction", "Route"]

from .map import Map
from .predictions import Alternative, Localization, Prediction
from .route import Drive, Located, Route
