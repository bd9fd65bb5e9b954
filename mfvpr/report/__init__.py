"""Results for people: tables, figures, and the files of a run folder."""
