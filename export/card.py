"""Card of a bundle: a README.md with the front matter of Hugging Face's hub, from the contract alone."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from typing import Any

from rlservo.bundle.contract import Contract, Evaluation
from rlservo.bundle.spaces import DiscreteSpec, LeafSpec, leaf_specs

MOST = 96  # elements of a leaf that are listed one by one


def card(contract: Contract, *, license: str = "", place: str = "") -> str:
    """Return the README.md of a bundle.

    `license` is an identifier of the hub's, such as `apache-2.0`; `place` is what `Policy.load` and `rlservo serve` are
    given (default: the policy's folder).
    """
    parts = [
        _front_matter(contract, license),
        f"# {contract.name} {contract.version}",
        contract.description or f"A policy in the bundle format of rlservo: {_task(contract)}.",
        *_space("Observation", "obs", contract.observation_space),
        *_space("Action", "action", contract.action_space),
        f"Control rate: {f'{contract.control_rate_hz:g} Hz' if contract.control_rate_hz else 'not known'}."
        + "".join(f" Remembered from step to step: {leaf.name}." for leaf in contract.state),
        "## Training",
        _table(("", ""), _training(contract)),
        _proof(contract),
        "## Success",
        *_success(contract.evaluations),
        "## Use",
        _use(contract, place or f"policies/{contract.name}"),
        "## License",
        license or "Not stated.",
    ]
    return "\n\n".join(parts) + "\n"


def _front_matter(contract: Contract, license: str) -> str:
    origin = contract.provenance
    tags = ["reinforcement-learning", "robotics", "onnx", "rlservo"]
    tags += [each.lower() for each in (origin.algorithm, origin.source) if each not in ("unknown", "onnx")]
    data: dict[str, Any] = {"library_name": "rlservo", "pipeline_tag": "robotics", "tags": tags}
    if license:
        data["license"] = license
    if results := list(_results(contract)):
        data["model-index"] = [{"name": contract.name, "results": results}]
    # JSON is YAML, and quotes what a name may hold.
    return "\n".join(["---", *(f"{key}: {json.dumps(value)}" for key, value in data.items()), "---"])


def _results(contract: Contract) -> Iterator[dict[str, Any]]:
    for one in contract.evaluations:
        name = _where(one)
        metrics = [{"type": "mean_reward", "name": "mean return", "value": one.return_bundle}]
        if one.success_rate_bundle is not None:
            metrics.insert(0, {"type": "success_rate", "name": "success", "value": one.success_rate_bundle})
        yield {
            "task": {"type": "reinforcement-learning", "name": "reinforcement learning"},
            "dataset": {"type": one.env_id, "name": name},
            "metrics": metrics,
        }


def _task(contract: Contract) -> str:
    size, action = contract.observation_space.size, contract.action_space
    choice = f"one of {action.n} actions" if isinstance(action, DiscreteSpec) else f"{action.size} action elements"
    return f"{size} observation elements to {choice}"


def _space(title: str, root: str, space: Any) -> Iterator[str]:
    """Yield a table for each leaf."""
    for name, leaf in leaf_specs(space, root).items():
        yield f"## {title}" + (f": {_cell(name)}" if name != root else "")
        if isinstance(leaf, DiscreteSpec):
            yield f"One of {leaf.n} choices, {leaf.start} to {leaf.start + leaf.n - 1}."
            continue
        shape = "x".join(map(str, leaf.shape))
        low, high = (bound.ravel() for bound in leaf.bounds())
        if not leaf.elements or leaf.size > MOST:
            spans = [*dict.fromkeys(map(_span, low.tolist(), high.tolist()))]
            span = spans[0] if len(spans) == 1 else "their ranges " + ", ".join(spans[:4] + ["..."] * (len(spans) > 4))
            yield f"{shape} numbers ({leaf.dtype}), {span}; they are not named one by one."
            continue
        yield _table(("#", "name", "unit", "what", "range"), _rows(leaf, low.tolist(), high.tolist()))


def _rows(leaf: LeafSpec, low: Sequence[float], high: Sequence[float]) -> Iterator[tuple[str, ...]]:
    for index, element in enumerate(leaf.elements):
        what = [element.quantity or "", element.joint and f"of {element.joint}", element.axis]
        what.append(element.frame and f"in {element.frame}")
        span = _span(low[index], high[index])
        yield str(index), element.name, element.unit or "-", " ".join(filter(None, what)), span


def _span(low: float, high: float) -> str:
    return "not bounded" if low == -math.inf and high == math.inf else f"{low:.4g} to {high:.4g}"


def _training(contract: Contract) -> Iterator[tuple[str, str]]:
    origin = contract.provenance
    known = {
        "algorithm": origin.algorithm if origin.algorithm != "unknown" else "",
        "environment": origin.env_id,
        "iterations": origin.training_iterations and f"{origin.training_iterations:,}",
        "environment steps": origin.env_steps and f"{origin.env_steps:,}",
        "trainer": "not known (an ONNX file, taken as given)" if origin.source == "onnx" else origin.framework,
        "exported": f"{origin.exported_at}, rlservo {origin.rlservo_version}",
        "checkpoint (sha256)": origin.checkpoint_sha256,
    }
    return ((key, str(value)) for key, value in known.items() if value)


def _proof(contract: Contract) -> str:
    parity = contract.parity
    largest = max((one.max_rel for one in parity.formats.values()), default=0.0)
    return (
        f"Proven on {parity.samples:,} observations against {parity.reference}: the largest relative difference is "
        f"{largest:.1e}. Every file's hash is in SHA256SUMS."
    )


def _success(evaluations: Sequence[Evaluation]) -> Iterator[str]:
    if not evaluations:
        yield "Not measured: `rlservo verify` runs closed-loop episodes and adds them here."
        return
    rows = (
        (
            _where(one),
            str(one.episodes),
            "-" if one.success_rate_bundle is None else f"{one.success_rate_bundle:.1%}",
            "-" if one.success_interval is None else "{:.1%} to {:.1%}".format(*one.success_interval),
            f"{one.return_bundle:.4g}"
            + (" ({:.4g} to {:.4g})".format(*one.return_interval) if one.return_interval else ""),
        )
        for one in evaluations
    )
    yield _table(("environment, disturbance", "episodes", "success", "95% interval", "mean return (95%)"), rows)


def _where(one: Evaluation) -> str:
    return f"{one.env_id}, {one.disturbance}" if one.disturbance not in (None, "none") else one.env_id


def _use(contract: Contract, place: str) -> str:
    load = [f"policy = rlservo.Policy.load({json.dumps(place)})"]
    if place.startswith("hf://"):
        folder = f"{contract.name}/{contract.version}"
        load = [
            f"folder = huggingface_hub.snapshot_download({json.dumps(place.removeprefix('hf://'))})",
            f'policy = rlservo.Policy.load(f"{{folder}}/{folder}")',
        ]
    size = ", ".join(
        f"{name} {list(leaf.shape)}" for name, leaf in leaf_specs(contract.observation_space, "obs").items()
    )
    lines = ["import huggingface_hub" if len(load) > 1 else "", "import rlservo", *load]
    code = "\n".join(filter(None, [*lines, f"action = policy.act(obs)  # {size}"]))
    return f"```python\n{code}\n```\n\nOr serve it: `rlservo serve {place}`."


def _table(head: Sequence[str], rows: Iterator[tuple[str, ...]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(map(_cell, line))} |" for line in lines)


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")
