"""Rule by which clients of one version of a policy can use another one: the same parts, shapes, types and bounds.

Clients refuse an answer by it, and servers an alias, a canary and a shadow. Names of elements and the control rate may
differ: clients send and use arrays by position. But an element that both versions name must be in the same
place, or a robot would move another joint, and what both say of quantity, joint, frame or a quaternion's order must be
the same.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

import numpy as np

from rlservo.bundle.contract import Contract
from rlservo.bundle.conventions import contradiction
from rlservo.bundle.spaces import Element, LeafSpec, element_label, leaf_specs

MOST_SHOWN = 3  # differences in a sentence


def interface_differences(contract: Contract, known: Contract) -> str:
    """Return why clients of the known version cannot use this one, with both values; empty if they can."""
    found: list[str] = []
    for root, space, before in (
        ("obs", contract.observation_space, known.observation_space),
        ("action", contract.action_space, known.action_space),
    ):
        ours, theirs = leaf_specs(space, root), leaf_specs(before, root)
        found += [f"{name} is new" for name in ours if name not in theirs]
        found += [f"{name} is missing" for name in theirs if name not in ours]
        found += [each for name in ours if name in theirs for each in _leaf(name, ours[name], theirs[name])]
    if contract.has_reward != known.has_reward:
        found.append(f"the reward input is {'new' if contract.has_reward else 'missing'}")
    return _shown(found)


def harmless_differences(contract: Contract, known: Contract) -> str:
    """Return what else differs for a client, with both values: names, units, what only one says, the control rate."""
    found: list[str] = []
    for root, space, before in (
        ("obs", contract.observation_space, known.observation_space),
        ("action", contract.action_space, known.action_space),
    ):
        theirs = leaf_specs(before, root)
        for name, leaf in leaf_specs(space, root).items():
            for index, (now, was) in enumerate(_elements(leaf, theirs.get(name, leaf))):
                if now != was:
                    found.append(f"{name} element {index} is {now} instead of {was}")
    if contract.control_rate_hz != known.control_rate_hz:
        found.append(f"the control rate is {_rate(contract)} instead of {_rate(known)}")
    return _shown(found)


def _leaf(name: str, leaf: LeafSpec, known: LeafSpec) -> Iterator[str]:
    for what, now, was in (
        ("is a", leaf.kind, known.kind),
        ("has shape", leaf.shape, known.shape),
        ("has dtype", leaf.dtype, known.dtype),
    ):
        if now != was:
            yield f"{name} {what} {now} instead of {was}"
            return
    for side, ours, theirs in zip(("low", "high"), leaf.bounds(), known.bounds(), strict=True):
        for index in np.flatnonzero(ours.ravel() != theirs.ravel())[:1]:
            which = f" element {element_label(leaf, int(index))}" if leaf.shape else ""
            yield f"{name}{which} has {side} {ours.ravel()[index]:g} instead of {theirs.ravel()[index]:g}"
    if len(leaf.elements) == len(known.elements) and (
        found := contradiction(leaf.elements, known.elements, labels=False)
    ):
        yield f"{name} {found[0]} {found[1]} instead of {found[2]}"
    places, before = _places(leaf), _places(known)
    moved = [element for element, place in places.items() if before.get(element, place) != place]
    if moved:
        yield f"{name} has '{moved[0]}' as element {places[moved[0]]} instead of {before[moved[0]]}"


def _places(leaf: LeafSpec) -> dict[str, int]:
    """Return the place of each element whose name is the only one of its kind."""
    names = [element.name for element in leaf.elements]
    counts = Counter(names)
    return {name: place for place, name in enumerate(names) if name and counts[name] == 1}


def _elements(leaf: LeafSpec, known: LeafSpec) -> Iterator[tuple[str, str]]:
    for index in range(max(len(leaf.elements), len(known.elements))):
        now, was = (each.elements[index : index + 1] for each in (leaf, known))
        yield _label(now), _label(was)


def _label(elements: tuple[Element, ...]) -> str:
    if not elements:
        return "without a name"
    element = elements[0]
    said = [element.quantity or "", element.joint and f"of {element.joint}", element.frame and f"in {element.frame}"]
    return ", ".join([f"'{element.name}' [{element.unit or 'no unit'}]", *filter(None, said)])


def _rate(contract: Contract) -> str:
    return "unknown" if contract.control_rate_hz is None else f"{contract.control_rate_hz:g} Hz"


def _shown(found: list[str]) -> str:
    more = f" and {len(found) - MOST_SHOWN} more" if len(found) > MOST_SHOWN else ""
    return ", ".join(found[:MOST_SHOWN]) + more
