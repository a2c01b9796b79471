"""Files for other programs, one format at a time: what is lost on the way and what opens them stands beside
them.
"""
