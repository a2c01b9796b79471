"""Localizers: from one picture with depth to a camera pose relative to a map."""
