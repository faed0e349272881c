"""The command `rlservo compile`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rlservo.deploy import terminal
from rlservo.deploy.commands.bundle_folder import FOLDER, Version, bundle_of
from rlservo.deploy.terminal import Json, print_json
from rlservo.extras import needs_extra


def compile(
    bundle: Annotated[Path, typer.Argument(help=FOLDER)],
    out: Annotated[Path, typer.Option(help="Folder for the C files; an earlier one of the same policy is replaced.")],
    cc: Annotated[
        str | None, typer.Option(help="C compiler for the proof; $CC or the machine's own by default.")
    ] = None,
    version: Version = None,
    as_json: Json = False,
) -> None:
    """Convert a bundle to one proven C99 file.

    A difference is an error, and nothing is written. Without a C compiler the files are written but marked unproven;
    the self-test next to them proves them on a machine that has one.

    Example: `rlservo compile policies/ur5 --out build`
    """
    with needs_extra("train", "onnx"):
        from rlservo.export.compiled.compile import compile_bundle

    chosen = bundle_of(bundle, version)
    with terminal.status("importing") as show, terminal.ends_like_ctrl_c(), terminal.writing(out):
        made = compile_bundle(chosen, out, compiler=cc, progress=show)
    if as_json:
        print_json({"path": str(made.folder), **made.about})
        return
    proof = made.proof
    lines = [f"written   {made.folder}: {made.about['prefix']}.c, .h, _test.c"]
    if proof is None:
        lines.append(f"unproven  {made.about['unproven']}")
    else:
        lines += [
            f"proven    {proof.golden_vectors} golden vectors, {proof.observations:,} observations compared with "
            f"onnxruntime, largest difference {proof.max_abs:.2g} ({proof.max_rel:.0%} of what is allowed)",
            f"rounding  {proof.rounding_used} observations beyond the contract's tolerance, by no more than rounding "
            f"explains (at most {proof.rounding_most:.0f} times the tolerance)",
            f"step      {proof.step_us['median']:.1f} µs median, {proof.step_us['slowest_observation']:.1f} µs for the "
            f"slowest observation, {proof.step_us['p99']:.1f} µs 99%, {proof.step_us['longest']:.0f} µs longest here "
            f"({proof.compiler}, {' '.join(proof.flags)})",
            f"memory    {proof.code_bytes / 1000:,.0f} kB code and weights, {proof.state_bytes:,} bytes state"
            + (f", {proof.stack_bytes:,} bytes stack" if proof.stack_bytes is not None else ""),
        ]
    for line in lines:
        terminal.output().print(line, markup=False, highlight=False, soft_wrap=True)
