"""Gather the registrations of all sessions into one artifact with a summary."""
