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
    "balancing_c",
    "best_setting",
    "calibration_data",
    "confidence_inputs",
    "estimate",
    "evaluation_protocol",
    "fit_confidence",
    "fuse_scales",
    "halves",
    "match_sequence",
    "mcnemar",
    "neighboring_settings",
    "precision_recall",
    "rank_dataset",
    "read_confidences",
    "reliability",
    "separate",
    "write_confidences",
]

from .calibration import calibration_data
from .confidence import (
    Confidence,
    confidence_inputs,
    fit_confidence,
    precision_recall,
    read_confidences,
    reliability,
    write_confidences,
)
from .dataset_ranking import RankedDataset, Recall, match_sequence, rank_dataset
from .drives import Drive, DriveFilter
from .protocol import (
    EvaluationProtocol,
    Half,
    Split,
    best_setting,
    evaluation_protocol,
    halves,
    neighboring_settings,
    separate,
)
from .rankings import FinalScore, FrameCorrelation, Fusion, Matched, Ranked, balancing_c, fuse_scales
from .statistics import estimate, mcnemar
from .system import Pipeline, System
