"""ceilvo: localisation of indoor robots that look at the ceiling. Shared vocabulary, no behaviour."""

import os

# Of a picture: more than any calibration has (7680 x 4320). A few hundred bytes of JPEG may say that they are 30000 x
# 30000, which is 2 GB. Read when OpenCV is loaded.
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(7680 * 4320))

__version__ = "0.1.0"
