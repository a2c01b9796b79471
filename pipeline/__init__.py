"""The ground floor: orchestration, geometry, files and models. Never imports a stage."""

import os

# Read by OpenCV once, when it is loaded: a few hundred bytes can ask for gigabytes.
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(32 << 20))
