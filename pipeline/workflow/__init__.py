"""The batch workflow: declaration of the DAG, planner, runner, artifacts, recipes and the command line of
stages.
"""
