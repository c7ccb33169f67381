"""Which frame of a model is the end effector: a site, a place on a body or a geom, or what looks most like a tool."""

from __future__ import annotations

import re
from collections.abc import Mapping
from contextlib import suppress
from typing import NamedTuple

import mujoco
import numpy as np

from arm5dof.arm.chain import SLIDE, joints_of, matrix, path_to
from arm5dof.errors import UserError, nearest_hint

DEFAULT = "ee"
"""The site that is the end effector where there is one of that name and none is asked for."""

KINDS = ("body", "geom")
"""What a place may be given on."""
TOOLS = (
    r"\bee\b|\beef\b|\bend ?effector",
    r"\btcp\b",
    "tool",
    "grasp|pinch",
    "attachment",
    "gripper",
    r"hand(?!le)",
    "flange",
)
"""What tools are called, the most telling first, in a name whose words are apart and in lower case."""
PARTS = re.compile("^(?!.*(static|fixed)).*(finger|fngr|thumb|mov|pad|cam|knuckle|driver|spring|follower|coupler)")
"""What moving parts of a tool, and cameras on it, are called."""


class EndEffector(NamedTuple):
    """The model with the site that is the end effector."""

    spec: mujoco.MjSpec | None
    model: mujoco.MjModel
    site: int
    why: str
    """Why this one, where none was named; else empty."""


class _Place(NamedTuple):
    """A frame that is fixed to a body."""

    body: int
    position: np.ndarray
    quaternion: np.ndarray


def find_end_effector(spec: mujoco.MjSpec | None, model: mujoco.MjModel, wanted: str) -> EndEffector:
    """Find the site of a name, or make the one that is asked for.

    Args:
        spec: What the model was compiled from, if it is at hand; it stays as it is.
        model: The compiled model.
        wanted: A site's name; a body's or a geom's, with or without an offset `X Y Z` in its frame, metres, and after
            `body ` or `geom ` where that is not plain; or nothing, to choose.

    Raises:
        UserError: There is no such site, body or geom, or the model is to get a site and is only at hand compiled.
    """
    wanted = " ".join(wanted.split())
    sites = [model.site(i).name for i in range(model.nsite)]
    if (name := wanted or DEFAULT) in sites:
        return EndEffector(spec, model, sites.index(name), "")
    if not wanted:
        return _choose(spec, model)
    kind, _, rest = wanted.partition(" ")
    kinds, text = ((kind,), rest) if kind in KINDS and rest else (KINDS, wanted)
    place = next((found for k in kinds if (found := _place(model, k, text)) is not None), None)
    if place is None:
        what = "site, body or geom" if kinds == KINDS else kind
        names = [*(sites if kinds == KINDS else ()), *(name for k in kinds for name in _names(model, k))]
        hint = nearest_hint(text, [*filter(None, names)])
        raise UserError(f"the model has no {what} {text!r} to use as end effector: {hint}")
    return _with_site(spec, model, wanted, place, "")


def _names(model: mujoco.MjModel, kind: str) -> list[str]:
    if kind == "body":
        return [model.body(i).name for i in range(model.nbody)]
    return [model.geom(i).name for i in range(model.ngeom)]


def _place(model: mujoco.MjModel, kind: str, text: str) -> _Place | None:
    """Where `NAME` or `NAME X Y Z` is, on a body or a geom; None if there is none of that name."""
    name, offset = text, np.zeros(3)
    if found := re.fullmatch(r"(.+?)((?: \S+){3})", text):
        with suppress(ValueError):
            offset = np.array([float(word) for word in found[2].split()])
            name = found[1]
    names = _names(model, kind)
    if name not in names or not np.isfinite(offset).all():
        return None
    i = names.index(name)
    if kind == "body":
        return _Place(i, offset, np.array([1.0, 0, 0, 0]))
    position = model.geom_pos[i] + matrix(model.geom_quat[i]) @ offset
    return _Place(int(model.geom_bodyid[i]), position, model.geom_quat[i].copy())


def _with_site(spec: mujoco.MjSpec | None, model: mujoco.MjModel, name: str, place: _Place, why: str) -> EndEffector:
    """The model with one more site."""
    if spec is None:
        raise UserError(f"{name!r} is no site, and a compiled model can be given none: load it from its MJCF")
    spec = spec.copy()
    body = next(body for body in spec.bodies if body.id == place.body)
    body.add_site(name=name, pos=place.position, quat=place.quaternion)
    model = spec.compile()
    return EndEffector(spec, model, model.site(name).id, why)


def _choose(spec: mujoco.MjSpec | None, model: mujoco.MjModel) -> EndEffector:
    """The site, else the body, that is named like a tool and that joints move; else the last link of the longest chain.

    The model gets a site `ee` there, so that whatever is kept of it says what was chosen; one that is only at hand
    compiled is left as it is.
    """
    depth = [len(joints_of(model, path_to(model, b))) for b in range(model.nbody)]
    if not max(depth):
        raise UserError("the model has no joints that could be an arm's")
    # A tool's site is at its tip, its body where it begins; a body without geoms is there to be a frame.
    sites = {i: (model.site(i).name, (-depth[b],)) for i, b in enumerate(model.site_bodyid) if depth[b]}
    bodies = {b: (model.body(b).name, (d, int(model.body_geomnum[b]) > 0)) for b, d in enumerate(depth) if d}
    site, site_why = _most_like_a_tool(sites)
    body, body_why = _most_like_a_tool(bodies)
    if site is not None:
        why = f"chosen: site {site_why}"
        if spec is None:
            return EndEffector(spec, model, site, why)
        place = _Place(int(model.site_bodyid[site]), model.site_pos[site].copy(), model.site_quat[site].copy())
        return _with_site(spec, model, DEFAULT, place, why)
    if body is None:
        body = _last_link(model)
        body_why = f"{model.body(body).name or body!r}, the last link of the longest chain of joints"
    place = _Place(body, np.zeros(3), np.array([1.0, 0, 0, 0]))
    return _with_site(spec, model, DEFAULT, place, f"chosen: body {body_why}")


def _most_like_a_tool(named: Mapping[int, tuple[str, tuple[int, ...]]]) -> tuple[int | None, str]:
    """Of names by id, each with what is to be smallest beside, the id of the one that says most clearly that it is a
    tool, and why it; None if none does."""
    ranked = [(rank, *rest, i) for i, (name, rest) in named.items() if (rank := _rank(name)) is not None]
    if not ranked:
        return None, ""
    best = min(ranked)
    others = ", ".join(repr(named[i][0]) for *rest, i in ranked if (*rest,) == best[:-1] and i != best[-1])
    also = f" (so could be {others})" if others else ""
    return best[-1], f"{named[best[-1]][0]!r}, by its name{also}"


def _rank(name: str) -> int | None:
    words = _words(name)
    if PARTS.search(words):
        return None
    return next((k for k, tool in enumerate(TOOLS) if re.search(tool, words)), None)


def _words(name: str) -> str:
    return re.sub(r"[^a-z]+", " ", name.lower())


def _last_link(model: mujoco.MjModel) -> int:
    """The body with the most hinges before it, and then the fewest slides, which are fingers rather than joints of an
    arm; where there are no hinges, with the most slides. Of several the furthest from the world."""
    paths = [path_to(model, b) for b in range(model.nbody)]
    slides = [[bool(model.jnt_type[j] == SLIDE) for j in joints_of(model, path)] for path in paths]
    sign = -1 if not all(map(all, slides)) else 1
    links = [b for b in range(model.nbody) if slides[b] and not PARTS.search(_words(model.body(b).name))]
    key = lambda b: (slides[b].count(False), sign * sum(slides[b]), len(paths[b]), -b)
    return max(links or [b for b in range(model.nbody) if slides[b]], key=key)
