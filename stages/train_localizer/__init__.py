"""Train the scene's or the agent's localizer from random rendered views of its template."""
