"""Train the network that recognizes the turnaround's animal in sessions without depth."""
