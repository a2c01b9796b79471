"""The batch workflow: declaration of the DAG, planner, runner, artifacts, recipes, stages' command line."""
