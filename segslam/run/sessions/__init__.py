"""Several sessions in one frame: merging of finished runs, and localisation of a recording in a finished run."""
