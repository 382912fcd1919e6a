"""Joins small parts to one mesh, so that other programs get a scene of some dozens of things and not of a thousand pieces."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from iif_core.surface.triangles import face_geometry
from workflow.exporters.atlas import TexturedPart

NO_OBJECT = -1


def joined(parts: Sequence[TexturedPart], most: int) -> list[TexturedPart]:
    """Join the parts of least area until at most `most` are left, if lamps and the kinds of parts allow it.

    A lamp, or a part of it, stays by itself. Parts are joined if what a file says of a whole part is the same: whether it is a
    sheet that is seen from both sides, how much light passes it, and whether it was simplified. Vertices, normals and texture
    coordinates stay as they are.

    Returns:
        The parts that stay, in their order, and after them the joined ones: `small pieces`, of no object.
    """
    if len(parts) <= most:
        return list(parts)
    kinds = [(part.double_sided, part.opacity, part.simplified) for part in parts]
    area = np.array([face_geometry(part.vertices, part.faces)[1].sum() for part in parts])
    free = [int(i) for i in np.argsort(area, kind="stable") if parts[i].emitter_id < 0]

    # -------- the least parts leave, one by one, until those that stay and the joined ones are few enough --------
    groups: dict[tuple[bool, float, bool], list[int]] = defaultdict(list)
    for left, i in enumerate(free):
        if len(parts) - left + len(groups) <= most:
            break
        groups[kinds[i]].append(i)
    groups = {kind: members for kind, members in groups.items() if len(members) > 1}  # one alone would lose its name for nothing
    gone = {i for members in groups.values() for i in members}
    out = [part for i, part in enumerate(parts) if i not in gone]
    taken = {part.name for part in out}
    for members in groups.values():
        name = _free_name(taken)
        taken.add(name)
        out.append(_joined([parts[i] for i in sorted(members)], name))
    return out


def _joined(parts: Sequence[TexturedPart], name: str) -> TexturedPart:
    first = np.cumsum([0, *(len(part.vertices) for part in parts)])
    return replace(
        parts[0],
        name=name,
        object_id=NO_OBJECT,
        vertices=np.concatenate([part.vertices for part in parts]),
        normals=np.concatenate([part.normals for part in parts]),
        uv=np.concatenate([part.uv for part in parts]),
        faces=np.concatenate([part.faces + at for part, at in zip(parts, first, strict=False)]).astype(parts[0].faces.dtype),
    )


def _free_name(taken: set[str]) -> str:
    number, name = 1, "small pieces"
    while name in taken:
        number += 1
        name = f"small pieces {number}"
    return name
