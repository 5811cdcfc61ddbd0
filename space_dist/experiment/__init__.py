"""What a grid of runs is on disk: its `manifest`, each run's `status`, and why a run ended (`endings`)."""
