"""The commands `rlservo replay` and `rlservo estimate`: recordings replayed with another bundle."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rlservo.deploy import terminal
from rlservo.deploy.commands.bundle_folder import FOLDER, Version, bundle_of
from rlservo.deploy.commands.log import Files, PolicyName
from rlservo.deploy.terminal import Json, print_json
from rlservo.errors import UsageError
from rlservo.extras import needs_extra

if TYPE_CHECKING:
    from rlservo.recording.replay.estimate import EstimateReport
    from rlservo.recording.replay.replay import ReplayReport

Bundle = Annotated[Path, typer.Option(help=FOLDER)]


def replay(
    files: Files,
    bundle: Bundle,
    tolerance: Annotated[
        float, typer.Option(min=0.0, help="Largest difference in an element that does not count as a change.")
    ] = 0.0,
    version: Version = None,
    policy: PolicyName = None,
    as_json: Json = False,
) -> None:
    """Compare a bundle's actions with the recorded ones.

    Exit code 0: no action changes; 1: some change; 2: the recording does not fit the bundle.

    Example: `rlservo replay run.mcap --bundle policies/ur5/2`
    """
    with needs_extra("record"):
        from rlservo.recording.reader import Recording
        from rlservo.recording.replay.replay import replay as run_replay

    chosen, began = bundle_of(bundle, version), time.perf_counter()
    with terminal.status("replaying the recordings"):
        report = run_replay(Recording(files), chosen, tolerance=tolerance, name=policy)
    seconds = time.perf_counter() - began
    if as_json:
        print_json({**report.as_dict(), "seconds": round(seconds, 3)})
    else:
        _print_replay(report, seconds)
    if report.changed:
        raise typer.Exit(1)


def estimate(
    files: Files,
    bundle: Bundle,
    explore: Annotated[
        bool, typer.Option("--explore", help="Estimate the exploratory policy instead of the deterministic one.")
    ] = False,
    gamma: Annotated[float, typer.Option(help="Discount per step.")] = 1.0,
    version: Version = None,
    policy: PolicyName = None,
    seed: Annotated[int, typer.Option(min=0, help="Random seed of the bootstrap.")] = 0,
    as_json: Json = False,
) -> None:
    """Estimate a bundle's return from another's recordings.

    The recorded actions must have explored (`rlservo rollout --explore`). A deterministic policy is estimated only if
    its actions are discrete.

    Exit code 0: an estimate passes its method's own checks; 1: the recordings cannot support one.

    Example: `rlservo estimate recordings --bundle policies/ur5/2 --explore`
    """
    if not 0 < gamma <= 1:
        raise UsageError(f"--gamma must be above 0 and at most 1, got {gamma:g}")
    with needs_extra("record"):
        from rlservo.recording.reader import Recording
        from rlservo.recording.replay.estimate import estimate as run_estimate

    chosen = bundle_of(bundle, version)
    with terminal.status("reading the recordings") as show:
        report = run_estimate(
            Recording(files), chosen, explore=explore, gamma=gamma, name=policy, seed=seed, progress=show
        )
    if as_json:
        print_json(report.as_dict())
    else:
        _print_estimate(report)
    if not any(one.supported for one in report.estimates):
        raise typer.Exit(1)


def _print_replay(report: ReplayReport, seconds: float) -> None:
    _line(
        f"{', '.join(report.policies)} replayed through {report.bundle}: {report.compared} decisions in {seconds:.1f} s"
    )
    if report.same_graph is not None:
        _line(f"the graph is {'the recorded one' if report.same_graph else 'not the recorded one'}")
    _line(f"identical bit for bit: {report.identical} of {report.compared}")
    _line(f"changed by more than {report.tolerance:g}: {report.changed} ({report.changed_share:.2%})")
    if report.explored:
        _line(
            f"explored: {report.explored}, compared by their distributions' parameters, largest difference "
            f"{report.largest_distribution_difference:.3g}"
        )
    if report.unsafe:
        _line(f"bundle's actions outside its action space: {report.unsafe}")
    if report.not_compared:
        _line(f"not compared (no action, a gap, or nothing to compare with): {report.not_compared}")
    if report.dropped:
        _line(f"records dropped by the recorder: {report.dropped}")
    for title, count in report.other_policies.items():
        _line(f"skipped: {count} decisions of {title}")
    for element in report.elements:
        if element.largest:
            _line(
                f"  {element.name}: largest {element.largest:.4g} {element.unit}, mean {element.mean:.3g}, "
                f"changed {element.changed}"
            )
    for moment in report.worst:
        when = time.strftime("%Y-%m-%d %H:%M:%S", time.gmtime(moment.time_s))
        _line(
            f"  {when} UTC, episode {moment.episode or '-'} step {moment.step}: {moment.element} "
            f"{moment.recorded:.6g} -> {moment.replayed:.6g}"
        )


def _print_estimate(report: EstimateReport) -> None:
    _line(f"{report.bundle} ({report.target}) from {report.episodes} episodes of {', '.join(report.policies)}")
    assert report.recorded_return is not None and report.recorded_interval is not None
    several = len(report.recorded_by_policy) > 1
    together = f" of {len(report.recorded_by_policy)} versions together" if several else ""
    _line(f"recorded return{together} {report.recorded_return:.5g}  {_interval(report.recorded_interval)}")
    for title, (episodes, mean) in report.recorded_by_policy.items() if several else ():
        _line(f"  {title}: {mean:.5g} in {episodes} episodes")
    for reason, count in report.not_used.items():
        _line(f"not used: {count} episodes {reason}")
    for one in report.estimates:
        _line(
            f"{one.method}: {one.value:.5g}  {_interval(one.interval)}  effective episodes {one.effective_samples:.1f}"
        )
        _line(f"  {'holds' if one.supported else 'NOT SUPPORTED'}: {one.reason}")


def _interval(interval: tuple[float, float]) -> str:
    return f"(95% {interval[0]:.5g} to {interval[1]:.5g})"


def _line(text: str) -> None:
    terminal.output().print(text, markup=False, highlight=False, soft_wrap=True)
