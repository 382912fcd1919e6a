"""Decisions about light: what shines, what comes from outside, what is reflected more than once."""

from __future__ import annotations

import numpy as np

from iif_core.light.emission.search import STEP
from iif_core.light.emission.sun import SHARP, SunEvidence
from iif_core.light.emission.translucent import TRANSMITTANCE
from iif_core.light.unexplained import SIGNIFICANT, Strength
from workflow.decisions.plan import CACHE_COVERAGE
from workflow.decisions.record import FORCED, SETTLED, Decision, decision

_SUN = "share by which the misfit falls with a sun"


def sun(found: SunEvidence | None) -> Decision:
    """Decide about a sun that no camera sees (docs/method/light.md#the-sun).

    Args:
        found: what speaks for it; None = cameras see light from outside in all directions, unsaturated.
    """
    if found is None:
        return decision("sun", False, _SUN, 0.0, STEP, "cameras see the whole outside unsaturated")
    value = 1.0 - found.with_it / found.without if 0 < found.without < np.inf else 0.0
    reason = f"misfit {found.without:.4f}, and {found.with_it:.4f} with the best sun"
    if found.disc is not None:
        towards, size = ", ".join(f"{x:.2f}" for x in found.disc.direction), np.degrees(found.disc.radius)
        reason += f", towards ({towards}), {f'a disc of radius {size:.1f} degrees' if size else 'one texel'}"
        sharp = f"a narrow one does {found.narrow:.0%} of what the best one does"
        if found.narrow < SHARP:
            reason += f"; {sharp}, so that it is a bright part of the sky"
        else:
            reason += f", on views that its radiance was not found on; {sharp}"
    return decision("sun", found.is_sun, _SUN, value, STEP, reason)


def emitters(groups: int, dropped: int, candidates: int) -> Decision:
    """Decide about emitters: groups of faces that were found and kept by the solver."""
    if groups:
        reason = f"{groups} group{' emits' if groups == 1 else 's emit'} light ({dropped} candidates dropped)"
    elif candidates:
        reason = f"none of the {candidates} candidate groups emits light; light comes from cache and environment"
    else:
        reason = "no face was seen saturated often enough; light comes from cache and environment"
    return decision("emitters", groups > 0, "emitter groups", groups, 1, reason)


def transmission(names: str, shines: float, passes: float, possible: bool) -> Decision:
    """Decide whether objects that show what is behind them shine, or let light from outside through.

    That they show it speaks for the latter, unless it explains the other objects clearly worse
    (docs/method/light.md#surface-that-lets-light-through).

    Args:
        names: of the objects.
        shines, passes: misfit of the light (Eq. L.40) under either assumption, on the rows of other objects.
        possible: light comes from outside where the objects let it through, and the mesh stays closed otherwise.
    """
    measure = "share by which the misfit falls if light passes"
    value = 1.0 - passes / shines if 0 < shines < np.inf and np.isfinite(passes) else 0.0
    included = possible and passes < (1 + STEP) * shines
    what = f"{TRANSMITTANCE:.0%} of the light passes through {names}" if included else f"no light passes through {names}"
    reason = f"{what}: misfit {passes:.4f}, and {shines:.4f} if it shines"
    return decision("transmission", included, measure, value, -STEP, reason)


def denoiser(setting: bool) -> Decision:
    """Describe the denoiser of the re-renderings: paths are few, and nothing is fitted to them."""
    status, reason = (SETTLED, "views are re-rendered by few paths, which are noisy") if setting else (FORCED, "set to off")
    return decision("denoiser", setting, "whether re-renderings have the noise of paths", 1.0, 1.0, reason, status)


def unexplained(found: Strength) -> Decision:
    """Decide whether photographs tell of light that the model lacks (Eq. S.25)."""
    measure = "share of the squared error of re-renderings that other photographs take away, in standard errors"
    if not found.views:
        return decision("unexplained_light", False, measure, 0.0, SIGNIFICANT, "too few photographs show the same surface")
    sure = found.share / max(found.error, 1e-9)
    said = f"other photographs of the surface take {found.share:.0%} +- {found.error:.0%} off the squared error of re-renderings"
    return decision("unexplained_light", bool(found.beta.any()), measure, sure, SIGNIFICANT, said)


def radiance_cache(setting: str, coverage: float, censored: float) -> Decision:
    """Decide between photographed radiance and further bounces for indirect light (Eq. S.14); `setting` is `cache`, `path` or
    `auto`.

    `coverage` is the share of cosine-distributed rays from the surface that meet a known voxel, among those that meet no emitter;
    `censored` the share of the voxels that were seen by saturated pixels only.
    """
    measure = "share of secondary hits whose radiance was photographed"
    if setting != "auto":
        return decision("radiance_cache", setting == "cache", measure, coverage, CACHE_COVERAGE, f"set to {setting}", FORCED)
    reason = f"{coverage:.0%} of secondary hits were photographed ({censored:.1%} of the voxels only saturated)"
    return decision("radiance_cache", coverage > CACHE_COVERAGE, measure, coverage, CACHE_COVERAGE, reason)
