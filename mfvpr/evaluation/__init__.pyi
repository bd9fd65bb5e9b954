__all__ = [
    "Confidence",
    "Drive",
    "DriveFilter",
    "EvaluationProtocol",
    "FinalScore",
    "FrameCorrelation",
    "Fusion",
    "Half",
    "Matched",
    "Pipeline",
    "Ranked",
    "RankedDataset",
    "Recall",
    "Split",
    "System",
    "best_setting",
    "calibration_data",
    "confidence_inputs",
    "estimate",
    "evaluation_protocol",
    "fit_confidence",
    "halves",
    "match_sequence",
    "mcnemar",
    "neighboring_settings",
    "rank_dataset",
    "read_confidences",
    "separate",
    "write_confidences",
]

from .calibration import (
    Confidence,
    calibration_data,
    confidence_inputs,
    fit_confidence,
    read_confidences,
    write_confidences,
)
from .drives import Drive
from .evaluation import RankedDataset, Recall, rank_dataset
from .fusion import FinalScore, FrameCorrelation, Fusion
from .protocol import EvaluationProtocol, Split, evaluation_protocol
from .rankings import Matched, Ranked
from .selection import Half, best_setting, halves, neighboring_settings, separate
from .sequence_matching import match_sequence
from .sequences import DriveFilter
from .statistics import estimate, mcnemar
from .system import Pipeline, System
