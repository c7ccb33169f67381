"""Training: the trainer, run folders, checkpoints, evaluation and reports."""
