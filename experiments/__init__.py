"""The programs: settings -> plain values -> mfvpr.pipeline."""
