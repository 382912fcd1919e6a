"""The reflectance of the method as a BSDF plug-in of Mitsuba, with textures. A copy lies next to exported scenes, with
`iif_core.reflectance.brdf` and `iif_core.numerics.xp`; it therefore imports nothing else of the project."""

from __future__ import annotations

from typing import Any

from iif_core.numerics.xp import DRJIT
from iif_core.reflectance import brdf

NAME = "iif_cook_torrance"


def register() -> None:
    """Make the plug-in known to the variant of Mitsuba that is set, a JIT one such as `llvm_ad_rgb`, by its `NAME`."""
    import mitsuba as mi

    mi.register_bsdf(NAME, plugin())


def plugin() -> type:
    """Return the class: Cook-Torrance of Eq. R.1 to R.13 on both sides; parameters base_color, roughness and metallic, each a
    texture or a constant."""
    import drjit as dr
    import mitsuba as mi

    class CookTorrance(mi.BSDF):  # type: ignore[misc]
        def __init__(self, props: Any):
            super().__init__(props)
            self.base_color, self.roughness, self.metallic = (
                props.get_texture(name) for name in ("base_color", "roughness", "metallic")
            )
            flags = mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide | mi.BSDFFlags.BackSide
            self.m_flags, self.m_components = flags, [flags]

        def _surface(self, si: Any, active: Any) -> tuple[Any, Any, Any, Any]:
            """k_d, k_s, roughness, and the chance of the specular lobe for a viewer above the surface."""
            kd, ks = brdf.kd_ks(self.base_color.eval(si, active), self.metallic.eval_1(si, active))
            viewer = dr.abs(mi.Frame3f.cos_theta(si.wi))
            chance = brdf.specular_chance(DRJIT, dr.max(kd), dr.max(ks), viewer)
            return kd, ks, self.roughness.eval_1(si, active), chance

        def _viewer(self, si: Any) -> tuple[Any, Any]:
            """Direction to the viewer above the surface, and the sign that puts it there."""
            side = dr.select(mi.Frame3f.cos_theta(si.wi) < 0, -1.0, mi.Float(1))
            return mi.Vector3f(si.wi.x, si.wi.y, si.wi.z * side), side

        def _evaluate(self, surface: tuple[Any, Any, Any, Any], viewer: Any, light: Any) -> tuple[Any, Any]:
            """f cos and the density of a direction."""
            kd, ks, roughness, chance = surface
            normal = (mi.Float(0), mi.Float(0), mi.Float(1))
            NoL, NoV, NoH, VoH, sin2_h = brdf.half_angles(DRJIT, normal, light, viewer)
            diffuse, spec, fc = brdf.lobes(DRJIT, NoL, NoV, NoH, VoH, sin2_h, roughness)
            pdf = brdf.mixture_pdf(DRJIT, NoL, NoH, VoH, sin2_h, roughness, chance)
            value = brdf.compose(kd, ks, diffuse, spec * (1 - fc), spec * fc)
            above = (viewer.z > 0) & (light.z > 0)
            return dr.select(above, value, 0), dr.select(above, pdf, 0)

        def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> tuple[Any, Any]:
            viewer, side = self._viewer(si)
            surface = self._surface(si, active)
            half = brdf.sample_ggx_half(DRJIT, sample2.x, sample2.y, surface[2])
            mirrored = dr.normalize(mi.Vector3f(*brdf.reflect(viewer, half)))
            light = dr.select(sample1 < surface[3], mirrored, mi.Vector3f(*brdf.sample_cosine(DRJIT, sample2.x, sample2.y)))
            value, pdf = self._evaluate(surface, viewer, light)
            found = mi.BSDFSample3f()
            found.wo = mi.Vector3f(light.x, light.y, light.z * side)
            found.pdf, found.eta = pdf, mi.Float(1)
            found.sampled_type, found.sampled_component = mi.UInt32(+mi.BSDFFlags.GlossyReflection), mi.UInt32(0)
            return found, dr.select(active & (pdf > 0), value / pdf, 0)

        def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> tuple[Any, Any]:
            viewer, side = self._viewer(si)
            return self._evaluate(self._surface(si, active), viewer, mi.Vector3f(wo.x, wo.y, wo.z * side))

        def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self.eval_pdf(ctx, si, wo, active)[0]

        def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self.eval_pdf(ctx, si, wo, active)[1]

        def traverse(self, callback: Any) -> None:
            pass

    return CookTorrance
