__all__ = [
    "Confidence",
    "EvaluationProtocol",
    "Half",
    "Pipeline",
    "RankedDataset",
    "Recall",
    "Shard",
    "Split",
    "System",
    "best_setting",
    "calibration_data",
    "confidence_inputs",
    "estimate",
    "evaluation_protocol",
    "fill_shard",
    "fit_confidence",
    "halves",
    "hits",
    "match_sequence",
    "mcnemar",
    "neighboring_settings",
    "precision_recall",
    "rank_dataset",
    "read_confidences",
    "recall_at_k",
    "reliability",
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
from .evaluation import RankedDataset, Recall, rank_dataset
from .metrics import hits, precision_recall, recall_at_k, reliability
from .protocol import EvaluationProtocol, Split, evaluation_protocol
from .selection import Half, best_setting, halves, neighboring_settings, separate
from .sequence_matching import match_sequence
from .shards import Shard, fill_shard
from .statistics import estimate, mcnemar
from .system import Pipeline, System
