"""Bill of materials of a bundle (ML-BOM): CycloneDX 1.6 in JSON, from the contract and the hashes alone."""

from __future__ import annotations

import uuid
from collections.abc import Iterator, Mapping
from typing import Any
from urllib.parse import quote

from rlservo.bundle.contract import Contract
from rlservo.bundle.spaces import leaf_specs


def bill_of_materials(contract: Contract, digest: str, sums: Mapping[str, str]) -> dict[str, Any]:
    """Return the document: the policy, its files by `sums` (SHA-256), and what the export knows it was made of."""
    origin = contract.provenance
    policy = f"{contract.name}@{contract.version}"
    files = (_part("file", name, **_sha256(sums[name])) for name in sorted(sums))
    parts = list({part["bom-ref"]: part for part in (*_made_of(contract), *files)}.values())
    return {
        "$schema": "http://cyclonedx.org/schema/bom-1.6.schema.json",
        "bomFormat": "CycloneDX",
        "specVersion": "1.6",
        "serialNumber": f"urn:uuid:{uuid.uuid5(uuid.NAMESPACE_URL, f'sha256:{digest}')}",
        "version": 1,
        "metadata": {
            "timestamp": origin.exported_at,
            "tools": {"components": [_part("application", "rlservo", origin.rlservo_version)]},
            "component": {
                **_part("machine-learning-model", contract.name, contract.version, **_sha256(digest)),
                "bom-ref": policy,
                "modelCard": _model_card(contract),
            },
        },
        "components": parts,
        "dependencies": [{"ref": policy, "dependsOn": [part["bom-ref"] for part in parts]}],
    }


def _part(kind: str, name: str, version: str | None = None, **more: Any) -> dict[str, Any]:
    known = {"version": version} if version else {}
    return {"type": kind, "bom-ref": f"{kind}:{name}", "name": name, **known, **more}


def _sha256(digest: str) -> dict[str, Any]:
    return {"hashes": [{"alg": "SHA-256", "content": digest}]}


def _made_of(contract: Contract) -> Iterator[dict[str, Any]]:
    origin = contract.provenance
    if origin.framework:
        name, _, version = origin.framework.rpartition(" ")
        yield _part("library", name, version) if name else _part("library", version)
    for package, installed in (("ray", origin.ray_version), ("torch", origin.torch_version)):
        if installed:
            yield _part("library", package, installed, purl=f"pkg:pypi/{package}@{quote(installed)}")
    yield _part("data", "checkpoint", **_sha256(origin.checkpoint_sha256), data=[{"type": "other"}])
    if origin.env_id:
        yield _part("application", origin.env_id, description="training environment")


def _model_card(contract: Contract) -> dict[str, Any]:
    leaves = (leaf_specs(contract.observation_space, "obs"), leaf_specs(contract.action_space, "action"))
    inputs, outputs = (
        [{"format": f"{name}: {leaf.dtype} {list(leaf.shape)}"} for name, leaf in side.items()] for side in leaves
    )
    metrics = [
        {
            "type": kind,
            "value": str(value),
            "slice": f"{each.episodes} episodes of {each.env_id}, disturbance {each.disturbance or 'none'}",
            **({"confidenceInterval": dict(zip(("lowerBound", "upperBound"), map(str, interval), strict=True))}
               if interval else {}),
        }
        for each in contract.evaluations
        for kind, value, interval in (
            ("success rate", each.success_rate_bundle, each.success_interval),
            ("mean return", each.return_bundle, each.return_interval),
        )
        if value is not None
    ]  # fmt: skip
    return {
        "modelParameters": {
            "approach": {"type": "reinforcement-learning"},
            "task": contract.provenance.env_id or "control",
            "architectureFamily": contract.provenance.algorithm,
            "modelArchitecture": contract.provenance.module_class,
            "inputs": inputs,
            "outputs": outputs,
        },
        **({"quantitativeAnalysis": {"performanceMetrics": metrics}} if metrics else {}),
    }
