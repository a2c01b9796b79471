"""Files for other programs, one format at a time, with what is lost on the way and what opens them."""
