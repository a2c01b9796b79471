"""Register one session to the scene template: pose votes, joint alignment of all frames, agent roots."""
