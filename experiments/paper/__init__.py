"""The paper's evaluation: its systems, data sets, tables and figures, of whatever is at hand."""
