"""Materials of single faces, for rooms whose reflectance is known."""

from iif_core.light.transport.materials import _Rows


class FaceMaterials:
    """One material for each face: face_values (m, 5)."""

    def __init__(self, face_values):
        self._rows = _Rows(face_values, "face_values")

    def __call__(self, point, face, object_id, active):
        return self._rows.read(face, active & (face < self._rows.count))
