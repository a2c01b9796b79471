"""Give a recording without depth what the others have: cameras in the map, and depth of room and animal."""
