"""The reflectance of the metal of Mitsuba's plug-in `principled`, integrated by the plug-in itself."""

import numpy as np

from workflow.exporters.mitsuba_lobes import ROUGHNESS
from workflow.runtime import device

_ANGLES, _SAMPLES = 16, 4096


def metal_reflectance():
    """Integrate the metal of `principled` over all directions: (2, 20) by base colour 0 or 1, and `ROUGHNESS`.

    Directions are drawn by the plug-in, on strata of its two dimensions, for cosines of the viewer at the middle of equal shares
    of the projected hemisphere.
    """
    mi = device.mitsuba()
    return np.array([[_reflectance(mi, base, r) for r in ROUGHNESS] for base in (0.0, 1.0)])


def _reflectance(mi, base, roughness):
    import drjit as dr

    bsdf = mi.load_dict(
        {
            "type": "principled",
            "base_color": {"type": "rgb", "value": base},
            "metallic": 1.0,
            "roughness": float(roughness),
        }
    )
    count = _ANGLES * _SAMPLES
    index = np.arange(count)
    side = int(np.sqrt(_SAMPLES))
    own = index % _SAMPLES
    cosine = np.sqrt((index // _SAMPLES + 0.5) / _ANGLES)
    si = dr.zeros(mi.SurfaceInteraction3f, count)
    si.wi = mi.Vector3f(np.sqrt(1 - cosine**2).astype(np.float32), 0.0, cosine.astype(np.float32))
    si.sh_frame = mi.Frame3f(mi.Normal3f(0, 0, 1))
    square = mi.Point2f(((own % side + 0.5) / side).astype(np.float32), ((own // side + 0.5) / side).astype(np.float32))
    lobe = mi.Float((np.modf(own * 0.6180339887498949)[0]).astype(np.float32))  # golden ratio: every stratum meets every lobe
    _, weight = bsdf.sample(mi.BSDFContext(), si, lobe, square)
    return float(np.array(weight.x, np.float64).mean())
