"""What precedes behaviour, against truth: masks, flow, registration, localizer, reconstruction."""
