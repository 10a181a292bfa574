"""The part of a view that a camera shows sharply: there alone what is found, and what is missing, says where it is.

Further out a lamp's edge and the joint beside it are seen as one, and what is found nearer seems new.
"""

from __future__ import annotations

import cv2
import numpy as np

from ceilvo.calibration import Calibration, sharp_part, visible_polygon
from ceilvo.daemon.slam.upkeep import inside
from ceilvo.types import Array, Crossings, Observations

MARGIN_PX = 50.0
"""A crossing nearer to the side of the picture may lack the edge points of one of its lines; chosen."""
_FOUND, _SHOWN = 0.7, 0.6
"""Shares of the pixels a metre right above the camera: with more, whatever is there is found; with less, what is found
may be something else. Measured: a camera 24 deg off the vertical found half of the lamps' corners above it, 13 % at 0.7
and none at 0.6. A lens of 76 deg that stands upright has 0.64 and more everywhere."""
_YOUNG_VIEWS, _YOUNG_M2 = 1.5, 12.0
"""See SharpView.young_m2; chosen."""


class SharpView:
    """Of one camera.

    Attributes:
        visible_m: (V, 2) corners in base of the part in which whatever is there would be seen.
    """

    def __init__(self, calibration: Calibration, max_view_deg: float) -> None:
        shown = visible_polygon(calibration, MARGIN_PX, max_view_deg)
        self.visible_m = sharp_part(calibration, shown, max_view_deg, _FOUND)
        reach_m = calibration.ceiling_height_m * np.tan(np.radians(max_view_deg))
        square = calibration.mount_xy_m + reach_m * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
        self._sharp_m = sharp_part(calibration, square, max_view_deg, _SHOWN)

    @property
    def area_m2(self) -> float:
        """Of the part in which whatever is there would be seen."""
        return abs(float(cv2.contourArea(self.visible_m.astype(np.float32)))) if len(self.visible_m) else 0.0

    @property
    def young_m2(self) -> float:
        """A map that knows no more ground than this is all around the robot."""
        return min(_YOUNG_VIEWS * self.area_m2, _YOUNG_M2)

    def shown(self, crossings: Crossings, view: Observations) -> Array:
        """(V, 2) corners in base of the ground that a view showed whole, (0, 2) for none.

        Of a ceiling that slopes it is what lies between its features: how high it is elsewhere is another question.
        """
        if crossings.complete or crossings.several or not len(view) or not len(self.visible_m):
            return view.visible_m
        found = view.xy_base_m[inside(self.visible_m, view.xy_base_m)]
        return _hull(found) if len(found) else view.visible_m

    def looked_at(self, view: Observations) -> Array:
        """(V, 2) corners in base of all that a view looked at: what it shows at the rim was seen as well."""
        if not len(view):
            return self.visible_m
        return _hull(np.concatenate([self.visible_m, view.xy_base_m]))

    def of(self, view: Observations) -> Observations:
        """The features that are seen sharply."""
        if not len(view) or not len(self._sharp_m):
            return view
        sharp = inside(self._sharp_m, view.xy_base_m)
        return view if np.all(sharp) else view.of(sharp)


def _hull(xy_m: Array) -> Array:
    """(V, 2) corners of the convex hull of points (N, 2)."""
    return np.asarray(cv2.convexHull(xy_m.astype(np.float32)).reshape(-1, 2), np.float64)
