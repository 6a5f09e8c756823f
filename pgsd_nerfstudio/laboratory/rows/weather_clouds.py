"""Figures of the captured sun under clouds: sunlit and shaded parts, contrast and colour over the borders of shadows."""

from __future__ import annotations

from collections.abc import Iterator

from jaxtyping import Float
from torch import Tensor

from pgsd_nerfstudio.laboratory.overcast_courtyard import overcast_courtyard
from pgsd_nerfstudio.laboratory.records import Record
from pgsd_nerfstudio.rendering.display import linear
from pgsd_nerfstudio.response.light import luminance
from pgsd_nerfstudio.scene.gaussians import Gaussians

SOURCE = "exact: the courtyard's albedo times an overcast sky by rays, in float64"


def rows(metric: Gaussians, softening: Float[Tensor, "n 3"] | None, quick: bool) -> Iterator[Record]:
    """All rows.

    Args:
        metric: the demo's Gaussians in metres, with plain RGB.
        softening: factors of the clouds on them; None if no sun was found.
        quick: fewer rays for the exact light.
    """
    if softening is None:
        yield Record("clouds: sun of the demo", None, "", holds=False, source="no sun was found")
        return
    exact = overcast_courtyard(32 if quick else 96)
    clear = linear(metric.colors[: len(exact.light)])
    found = clear * softening[: len(clear)]
    for name, where, target in (("the sun shone on", exact.sunlit, "<= 0.2"), ("a shadow lay on", exact.shaded, "<= 0.4")):
        ours, true = (_stops(light[where], clear[where]) for light in (found, exact.light))
        yield Record.judged(
            f"clouds: light of what {name}, against the exact one", float((ours.median() - true.median()).abs()),
            "stops", target, source=f"{float(ours.median()):+.2f} against {float(true.median()):+.2f} stops, medians; means "
            f"{float(ours.mean()):+.2f} and {float(true.mean()):+.2f}; {SOURCE}",
        )  # fmt: skip
    here, there = exact.lit_side, exact.shaded_side
    edges = [_stops(light[here], light[there]) for light in (clear, found, exact.light)]
    before, after, true = (float(edge.median()) for edge in edges)
    yield Record.judged(
        "clouds: contrast left over the border of a shadow", abs(after), "stops, median", "<= 0.4",
        source=f"{len(here):,} pairs of equal albedo within 30 cm; {before:.2f} without weather, exact {true:.2f}; nine of ten "
        f"are below {float(edges[1].abs().quantile(0.9)):.2f}, before {float(edges[0].abs().quantile(0.9)):.2f}",
    )  # fmt: skip
    tints = [(_blue(light[here]) - _blue(light[there])).median() for light in (clear, found, exact.light)]
    before, after, true = (float(tint) for tint in tints)
    yield Record.judged(
        "clouds: blue against red left in a shadow", abs(after), "stops, median", "<= 0.2",
        source=f"over the same pairs; {abs(before):.2f} without weather, exact {abs(true):.2f}",
    )  # fmt: skip


def _stops(light: Float[Tensor, "n 3"], reference: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    return (luminance(light).clamp_min(1e-5) / luminance(reference).clamp_min(1e-5)).log2()


def _blue(light: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    return (light[:, 2].clamp_min(1e-5) / light[:, 0].clamp_min(1e-5)).log2()
