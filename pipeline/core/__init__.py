"""What every package stands on: coded errors, configuration, processes, threads, progress, training."""
