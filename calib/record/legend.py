"""What the record says about each step, each figure and each picture, for a reader who was not there."""

STEPS = {
    "intrinsics": ("The lens", "How the camera maps directions to pixels, from pictures of a printed board."),
    "projection": ("Tilt and height", "How the camera leans, and how high the ceiling is above it."),
    "mount": ("Place on the robot", "Where the camera sits, from a turn on the spot and a straight run."),
    "sigma": ("Observation noise", "How exact crossings are seen, by their distance. The filter weighs with it."),
    "survey": ("The ceiling", "Whether there is enough to see everywhere that the robot drives."),
    "check": ("Check", "The finished calibration against fresh pictures."),
}
"""Title and what it is for."""
FIGURES = {
    "lens model": "pinhole, pinhole with eight coefficients, or fisheye; chosen by the pictures left out of the fit",
    "focal length": "across and down the picture",
    "principal point": "where the optical axis meets the picture",
    "distortion": "how the lens differs from a pinhole, by coefficient",
    "pictures": "of the board; those far worse than the rest are dropped",
    "rms": "typical distance between where a corner was seen and where the lens puts it; 0.3 px or less is good",
    "coverage": "share of the picture that corners fell on, how far out, how many views lean, range of distances",
    "dropped": "left out of the fit",
    "method": "what was measured",
    "ceiling height": "above the camera",
    "height": "of the ceiling above the camera",
    "roll": "lean about the camera's own axes; 0 looks straight up",
    "pitch": "lean about the camera's own axes; 0 looks straight up",
    "tilt": "lean of the camera",
    "reprojection": "distance between where points were seen and where they should be",
    "lens": "refined together with the grid of the ceiling",
    "offset": "of the camera from the base's origin",
    "yaw": "of the camera's picture against the robot's heading, counted to the left",
    "spin": "turn on the spot: the camera must go on a circle",
    "run": "straight run: the camera must move along the heading",
    "wheels": "way by the ceiling over way by the wheels",
    "scale": "whether a metre is a metre: a second source beside the tile's size",
    "sigma_x(r)": "forward, as a polynomial of the distance r in metres",
    "sigma_y(r)": "to the left, likewise",
    "sigma_theta": "of the heading that one crossing gives",
    "mean error": "forward and left; should be 0 within its own uncertainty",
    "elsewhere": "how the curves go on where nothing was measured",
    "NIS": (
        "squared innovation over what was predicted, for each degree of freedom; 1 is as predicted, more is too bold"
    ),
    "crossings": "points where lines of the ceiling cross, which the robot steers by",
    "flicker": "lamps that go with the mains, as stripes in the picture",
    "map": "drawn below",
}
"""By their name in a step's figures."""
PICTURES = {
    "coverage.png": "Every corner that was found. Where it is red there was none.",
    "reprojection.svg": (
        "Reprojection errors of all corners, coloured by view. A round cloud about 0 is good; a colour that "
        "lies apart is a view that does not fit. The ring holds 63 % of them where they are normal."
    ),
    "vectors.svg": (
        "Reprojection errors over the picture, enlarged. Short and without order is good; a pattern is a lens"
        " that the model does not describe."
    ),
    "poses.svg": (
        "How the board was held, one outline each view; the dot is the camera. Leaning views, near and far, "
        "make the focal length sure."
    ),
    "uncertainty.svg": (
        "How sure the lens is over the picture, what a turn of the camera would undo taken out. It grows "
        "where no corner was seen."
    ),
    "radial.svg": "Errors by distance from the picture's middle. The mean along the radius should stay at 0.",
    "paths.svg": "Left: the camera during the turn on the spot. Right: the straight run.",
    "curves.svg": (
        "Observation noise against distance: what was measured (dots), the curve that the filter uses, and "
        "its 95 % band."
    ),
    "errors.svg": "Where known points were seen, about where they are, coloured by distance.",
    "map.png": "The ceiling as it was driven: dark or empty places are poor.",
}
"""By their file's name."""
