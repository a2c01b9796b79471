"""The learned and fitted models that stages share; a checkpoint is meaningless without its class."""
