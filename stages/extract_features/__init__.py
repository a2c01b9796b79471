"""Project the dense descriptors of one video onto the shared basis."""
