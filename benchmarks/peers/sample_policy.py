"""Write one policy in the two forms that the peers need: an RLModule checkpoint and a bundle with the same weights.

A UR5-sized PPO policy: 27 observations, 6 actions in [-1, 1], two layers of 256 tanh units, untrained (a forward pass
takes as long as a trained one's). It runs in a process of its own, so that torch is not in the load generator's.

    python benchmarks/peers/sample_policy.py FOLDER
"""

from __future__ import annotations

import logging
import sys
import warnings
from pathlib import Path

import gymnasium as gym
import numpy as np
import onnxruntime
import ray
import torch
from ray.rllib.algorithms.ppo.torch.default_ppo_torch_rl_module import DefaultPPOTorchRLModule

from rlservo.export import bundle as files
from rlservo.export.bundle import (
    BakedStep,
    BoxSpec,
    Contract,
    Distribution,
    FormatParity,
    Parity,
    Provenance,
    TensorSpec,
)

OBS, ACTIONS, HIDDEN = 27, 6, 256
CHECKPOINT, BUNDLE = "rl_module", "bundle"


class Actor(torch.nn.Module):
    """Encoder, mean head and clip: what the exporter writes, for this one architecture."""

    def __init__(self, module: DefaultPPOTorchRLModule) -> None:
        super().__init__()
        self.encoder = module.encoder.actor_encoder.net
        self.head = module.pi.net

    def forward(self, obs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        inputs = self.head(self.encoder(obs))
        return inputs[:, :ACTIONS].clamp(-1.0, 1.0), inputs


def main(folder: Path) -> None:
    torch.manual_seed(0)
    observation = gym.spaces.Box(-np.inf, np.inf, (OBS,), np.float32)
    action = gym.spaces.Box(-1.0, 1.0, (ACTIONS,), np.float32)
    module = DefaultPPOTorchRLModule(
        observation_space=observation,
        action_space=action,
        model_config={"fcnet_hiddens": [HIDDEN, HIDDEN], "fcnet_activation": "tanh", "vf_share_layers": False},
    )
    module.save_to_path(folder / CHECKPOINT)
    bundle = folder / BUNDLE / "sample" / "1"
    bundle.mkdir(parents=True)
    write_bundle(Actor(module).eval(), bundle)


def write_bundle(actor: Actor, folder: Path) -> None:
    example = torch.zeros(2, OBS)
    torch.onnx.export(
        actor,
        (example,),
        str(folder / files.ONNX_FILE),
        input_names=["obs"],
        output_names=["action", "action_dist_inputs"],
        dynamo=True,
        external_data=False,
        dynamic_shapes=({0: torch.export.Dim("batch", min=1)},),
        verbose=False,
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # torch prefers torch.export; bundles hold TorchScript
        torch.jit.save(torch.jit.trace(actor, example), folder / files.TORCHSCRIPT_FILE)  # type: ignore[no-untyped-call]  # torch's
    obs = np.random.default_rng(0).standard_normal((8, OBS)).astype(np.float32)
    with torch.no_grad():
        expected = [output.numpy() for output in actor(torch.from_numpy(obs))]
    session = onnxruntime.InferenceSession(folder / files.ONNX_FILE)
    actual = session.run(["action", "action_dist_inputs"], {"obs": obs})
    difference = max(float(np.abs(a - b).max()) for a, b in zip(actual, expected, strict=True))
    if difference > 1e-5:
        raise SystemExit(f"the written graph differs from the RLModule by {difference}")
    files.write_golden(folder, {"obs": obs}, {"action": expected[0], "action_dist_inputs": expected[1]})
    files.write_contract(folder, contract_of(difference))


def contract_of(difference: float) -> Contract:
    return Contract(
        name="sample",
        version="1",
        description="An untrained policy of the UR5's size, for timing",
        observation_space=BoxSpec(shape=(OBS,), dtype="float32", low=None, high=None, elements=()),
        action_space=BoxSpec(shape=(ACTIONS,), dtype="float32", low=-1.0, high=1.0, elements=()),
        inputs=(TensorSpec(name="obs", dtype="float32", shape=(-1, OBS)),),
        outputs=(
            TensorSpec(name="action", dtype="float32", shape=(-1, ACTIONS)),
            TensorSpec(name="action_dist_inputs", dtype="float32", shape=(-1, 2 * ACTIONS)),
        ),
        distribution=Distribution(kind="diag_gaussian", transform="unsquash"),
        baked_in=tuple(BakedStep(step=step, detail="") for step in ("network", "mode", "clip")),
        control_rate_hz=10.0,
        provenance=Provenance(
            algorithm="PPO",
            api_stack="new",
            module_id="default_policy",
            module_class=DefaultPPOTorchRLModule.__name__,
            checkpoint_sha256="0" * 64,
            ray_version=ray.__version__,
            torch_version=torch.__version__,
            rlservo_version="0",
            exported_at="1970-01-01T00:00:00Z",
        ),
        parity=Parity(
            reference="the RLModule's own layers",
            samples=8,
            batch_sizes=(8,),
            rtol=0.0,
            atol=1e-5,
            formats={"onnx": FormatParity(max_abs=difference, max_rel=0.0)},
        ),
    )


if __name__ == "__main__":
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    main(Path(sys.argv[1]))
