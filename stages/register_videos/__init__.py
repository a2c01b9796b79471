"""Register one session to the scene template: votes, one motion per video, alignment, agent roots."""
