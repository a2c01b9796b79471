"""What precedes behavior, against truth: masks, flow, registration, localizer, reconstruction."""
