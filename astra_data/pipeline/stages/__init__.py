"""One file per step of the pipeline; stages meet on disk and never import each other."""
