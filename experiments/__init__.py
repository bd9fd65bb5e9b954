"""The programs: settings -> plain values -> mfvpr.evaluation.stages."""
