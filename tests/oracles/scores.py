"""Single scores and protocols of one map, by the parts of which `metrics.Target` is made."""

import numpy as np

from iif_core.evaluation import metrics
from iif_core.evaluation.flip import Seen, difference


def l2(prediction, truth, mask):
    """Mean squared error over the masked pixels and the channels (Eq. E.2)."""
    difference = prediction[mask].astype(np.float64) - truth[mask]
    return float(np.mean(difference * difference))


def psnr(prediction, truth, mask):
    """10 log10(1 / MSE) in dB, at most 100 (Eq. E.3)."""
    return metrics._decibel(l2(prediction, truth, mask))


def ssim(prediction, truth, mask):
    """Structural similarity of pixels that count; the others get the truth on both sides (Eq. E.4)."""
    truth = np.where(np.isfinite(truth), truth, 0)
    filled = np.where(mask if mask.ndim == truth.ndim else mask[..., None], prediction, truth)
    return metrics._Structure(truth, mask).similarity(filled)


def scaled(prediction, truth, mask, limit=1.0):
    """The prediction times one gain per channel, sum truth / sum prediction over the mask (Eq. E.9)."""
    prediction = np.asarray(prediction, np.float64)
    return metrics._gained(prediction, prediction[mask].mean(0), np.asarray(truth, np.float64)[mask].mean(0), limit)


def oracle_affine(prediction, truth, mask, object_id, ridge=1e-6):
    """The prediction mapped by the affine of each object that is nearest to the truth (Eq. E.10)."""
    x = np.array(prediction, np.float64).reshape(*mask.shape, -1)
    y = np.asarray(truth, np.float64).reshape(*mask.shape, -1)
    if mask.any():
        x[mask] = metrics._Groups(object_id[mask], y[mask]).nearest(x[mask], ridge)
    return x.reshape(np.shape(prediction))


def flip(prediction, truth, mask, encoded=False):
    """LDR-FLIP, the mean over the masked pixels (Eq. E.6); `encoded`: the images are sRGB-encoded instead of linear."""
    truth = np.where(np.isfinite(truth), truth, 0)
    filled = np.where(mask[..., None], prediction, truth)
    images = (Seen(np.clip(image, 0, 1), encoded) for image in (filled, truth))
    return float(difference(*images)[mask].mean(dtype=np.float64))
