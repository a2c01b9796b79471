"""The length of an animal, the unit of distances that depend on the body and not on the sensor."""

import numpy as np

from pipeline.geometry.meshes import Mesh

TAIL = 0.025
"""Share of the surface that is left out at each end: tips of tail, ears and beak."""


def body_length_m(template: Mesh) -> float:
    """Return the longer horizontal extent of the central 95 % of a template's surface, agent frame."""
    area = np.bincount(template.faces.ravel(), np.repeat(template.face_areas(), 3), len(template.vertices))
    extents = []
    for place in template.vertices[:, [0, 2]].T:
        order = np.argsort(place)
        ends = np.interp([TAIL, 1 - TAIL], np.cumsum(area[order]) / area.sum(), place[order])
        extents.append(float(np.ptp(ends)))
    return max(extents)
