"""The public names of rlservo, loaded when they are first used.

```python
import rlservo

policy = rlservo.Policy.load("policies/ur5")
action = policy.act(obs)
```

It imports nothing until a name is used.
"""

TYPE_CHECKING = False  # type checkers read the name as true; importing it from `typing` takes milliseconds
if TYPE_CHECKING:
    from rlservo import errors
    from rlservo.client.admin_client import AdminClient
    from rlservo.client.policy_client import PolicyClient
    from rlservo.client.stream_client import StreamClient
    from rlservo.drive.control_loop import rollout
    from rlservo.drive.fallback import WithFallback
    from rlservo.export.export_checkpoint import export_checkpoint
    from rlservo.export.export_policy import export_policy
    from rlservo.policy.acting_policy import ActingPolicy
    from rlservo.policy.compiled_policy import CompiledPolicy
    from rlservo.policy.policy import Policy
    from rlservo.recording.recorded_policy import WithRecording
    from rlservo.recording.recorder import Recorder

    __version__: str

__all__ = [
    "ActingPolicy",
    "AdminClient",
    "CompiledPolicy",
    "Policy",
    "PolicyClient",
    "Recorder",
    "StreamClient",
    "WithFallback",
    "WithRecording",
    "__version__",
    "errors",
    "export_checkpoint",
    "export_policy",
    "rollout",
]

# Public name -> the module that holds it.
_MODULES = {
    "ActingPolicy": "rlservo.policy.acting_policy",
    "AdminClient": "rlservo.client.admin_client",
    "CompiledPolicy": "rlservo.policy.compiled_policy",
    "Policy": "rlservo.policy.policy",
    "PolicyClient": "rlservo.client.policy_client",
    "StreamClient": "rlservo.client.stream_client",
    "Recorder": "rlservo.recording.recorder",
    "WithFallback": "rlservo.drive.fallback",
    "WithRecording": "rlservo.recording.recorded_policy",
    "errors": "rlservo.errors",
    "export_checkpoint": "rlservo.export.export_checkpoint",
    "export_policy": "rlservo.export.export_policy",
    "rollout": "rlservo.drive.control_loop",
}

# The extra that installs what a name needs beyond the in-process runtime.
_EXTRAS = {
    "AdminClient": "client",
    "PolicyClient": "client",
    "Recorder": "record",
    "StreamClient": "client",
    "WithRecording": "record",
    "export_checkpoint": "train",
    "export_policy": "export",
}

if not TYPE_CHECKING:  # a type checker would take it for a promise of every name

    def __getattr__(name: str) -> object:
        """Import the object `name` on first use, and keep it."""
        if name == "__version__":
            value = _installed_version()
        elif name in _MODULES:
            value = _load(name)
        else:
            raise AttributeError(f"module 'rlservo' has no attribute {name!r}")
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    return sorted(__all__)


def _load(name: str) -> object:
    try:
        module = __import__(_MODULES[name], fromlist=[name])
        return module if name == "errors" else getattr(module, name)
    except ModuleNotFoundError as error:
        if name not in _EXTRAS or (error.name or "").startswith("rlservo"):
            raise
        from rlservo.extras import missing

        raise ModuleNotFoundError(missing(error.name, _EXTRAS[name], f"rlservo.{name}"), name=error.name) from None


def _installed_version() -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("rlservo")
    except PackageNotFoundError:  # the folders were put on the path by hand
        return "unknown"
