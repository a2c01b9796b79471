"""Register one session to the scene template: frame votes, one motion per video, pose graph, alignment, agent
roots."""
