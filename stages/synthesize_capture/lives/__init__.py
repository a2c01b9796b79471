"""Lives of the built-in animal without pictures: a second program of this room."""
