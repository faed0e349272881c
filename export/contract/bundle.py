"""The policy bundle: the one contract between the exporter and everything that runs a policy.

A bundle is a folder `<name>/<version>/` holding

    policy.onnx     the whole policy as one graph: raw observation in, environment-ready action out
    policy.ts       the same graph as TorchScript
    contract.json   what goes in, what comes out, what is baked in, how it was proven (`Contract` below)
    golden.npz      recorded inputs and outputs, replayed at every load
    SHA256SUMS      a hash of each of the files above (`sha256sum -c SHA256SUMS` checks them too)

This module reads and writes those files. It needs numpy and pydantic; it knows nothing of torch, ray, gymnasium,
onnx or onnxruntime, and never unpickles. A bundle may come from anybody who can write into a folder: only regular files
are read, sizes are bounded before anything is read, and what is used of a file is what its hash was checked on.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import re
import tempfile
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Annotated, Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from rlservo.export.contract.errors import BundleError, BundleTamperedError
from rlservo.export.contract.regular_files import FileTooLargeError, NotReadableError, blocks, open_regular

ONNX_FILE = "policy.onnx"
TORCHSCRIPT_FILE = "policy.ts"
CONTRACT_FILE = "contract.json"
GOLDEN_FILE = "golden.npz"
SUMS_FILE = "SHA256SUMS"
CONTRACT_KEY = "rlservo.contract"
"""Where the graph's own metadata repeat the contract."""

REWARD = "reward"  # the graph's input for what the last action brought, of a policy that was trained to see it
MAX_SUMS_BYTES = 1 << 16
MAX_FILES = 16  # the four, and what a user may have added
DESCRIPTORS = Path("/proc/self/fd")  # Linux: a file that this process has open, whether it has a name or not
BAD_ARCHIVE = (OSError, ValueError, EOFError, RuntimeError, KeyError, MemoryError, zlib.error, zipfile.BadZipFile)
"""What zipfile and numpy raise on archives that are none."""

NAME_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$"
VERSION_PATTERN = r"^([1-9][0-9]{0,8}|(0|[1-9][0-9]{0,8})\.(0|[1-9][0-9]{0,8})\.(0|[1-9][0-9]{0,8}))$"


Size: TypeAlias = Annotated[int, Field(ge=1)]
Shape: TypeAlias = tuple[Size, ...]
Tolerance: TypeAlias = Annotated[float, Field(ge=0.0, le=1e-2)]
"""Beyond it a difference is no rounding, whatever a contract says."""


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Element(_Model):
    """One number of an observation or an action, as a roboticist would call it."""

    name: str
    unit: str = Field("", description="SI unit such as 'rad', 'm/s'; '1' when dimensionless, '' when unknown")


class BoxSpec(_Model):
    """A Gymnasium Box.

    Bounds are one number for all elements or one per element in row-major order; null is unbounded.
    """

    kind: Literal["box"] = "box"
    shape: Shape
    dtype: str
    low: float | tuple[float | None, ...] | None
    high: float | tuple[float | None, ...] | None
    elements: tuple[Element, ...] = Field((), description="Empty, or one per element in row-major order")

    @property
    def size(self) -> int:
        return math.prod(self.shape)

    def bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return (low, high), each of the space's shape, with infinities where unbounded."""

        def fill(bound: float | tuple[float | None, ...] | None, infinity: float) -> NDArray[np.float64]:
            if isinstance(bound, tuple):
                flat = np.array([infinity if b is None else b for b in bound], dtype=np.float64)
                return flat.reshape(self.shape)
            return np.full(self.shape, infinity if bound is None else bound, dtype=np.float64)

        return fill(self.low, -math.inf), fill(self.high, math.inf)


class DiscreteSpec(_Model):
    """A Gymnasium Discrete: the integers start .. start + n - 1."""

    kind: Literal["discrete"] = "discrete"
    n: int = Field(ge=1)
    start: int = 0
    dtype: str = "int64"
    elements: tuple[Element, ...] = ()

    @property
    def shape(self) -> tuple[int, ...]:
        return ()

    @property
    def size(self) -> int:
        return 1

    def bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return (low, high), both inclusive and of shape ()."""
        return np.array(self.start, np.float64), np.array(self.start + self.n - 1, np.float64)


class MultiDiscreteSpec(_Model):
    """A Gymnasium MultiDiscrete: element i is one of `nvec[i]` integers from `start[i]` on, in row-major order."""

    kind: Literal["multi_discrete"] = "multi_discrete"
    shape: Shape
    nvec: tuple[Size, ...]
    start: tuple[int, ...]
    dtype: str = "int64"
    elements: tuple[Element, ...] = ()

    @property
    def size(self) -> int:
        return math.prod(self.shape)

    def bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return (low, high), both inclusive and of the space's shape."""
        low = np.array(self.start, np.float64).reshape(self.shape)
        return low, low + np.array(self.nvec, np.float64).reshape(self.shape) - 1


class MultiBinarySpec(_Model):
    """A Gymnasium MultiBinary: every element is 0 or 1."""

    kind: Literal["multi_binary"] = "multi_binary"
    shape: Shape
    dtype: str = "int8"
    elements: tuple[Element, ...] = ()

    @property
    def size(self) -> int:
        return math.prod(self.shape)

    def bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return (low, high), both inclusive and of the space's shape."""
        return np.zeros(self.shape), np.ones(self.shape)


class _NestedSpec(_Model):
    """What the contract's Dict and Tuple share."""

    @property
    def shape(self) -> tuple[int, ...]:
        """A nested space is no array."""
        return ()

    @property
    def size(self) -> int:
        """The elements of all leaves."""
        assert isinstance(self, DictSpec | TupleSpec)
        return sum(leaf.size for leaf in leaf_specs(self, "").values())

    @property
    def elements(self) -> tuple[Element, ...]:
        """Only leaves name elements."""
        return ()


class DictSpec(_NestedSpec):
    """A Gymnasium Dict; its leaves are tensors of their own, called `obs.<key>` or `action.<key>`."""

    kind: Literal["dict"] = "dict"
    spaces: dict[str, SpaceSpec]


class TupleSpec(_NestedSpec):
    """A Gymnasium Tuple; its leaves are tensors of their own, called `obs.<index>` or `action.<index>`."""

    kind: Literal["tuple"] = "tuple"
    spaces: tuple[SpaceSpec, ...]


LeafSpec: TypeAlias = BoxSpec | DiscreteSpec | MultiDiscreteSpec | MultiBinarySpec
SpaceSpec = Annotated[
    BoxSpec | DiscreteSpec | MultiDiscreteSpec | MultiBinarySpec | DictSpec | TupleSpec, Field(discriminator="kind")
]
DictSpec.model_rebuild()
TupleSpec.model_rebuild()


def leaf_specs(space: SpaceSpec, name: str) -> dict[str, LeafSpec]:
    """Return every leaf of a space by tensor name, `name` or `name.<path>`: Dict keys sorted, as RLlib has them."""
    if isinstance(space, DictSpec):
        inside = {key: space.spaces[key] for key in sorted(space.spaces)}
    elif isinstance(space, TupleSpec):
        inside = {str(index): child for index, child in enumerate(space.spaces)}
    else:
        return {name: space}
    return {path: leaf for key, child in inside.items() for path, leaf in leaf_specs(child, f"{name}.{key}").items()}


class TensorSpec(_Model):
    """A named input or output of the graph. The first axis is the batch, -1."""

    name: str
    dtype: str
    shape: tuple[int, ...]

    @field_validator("shape")
    @classmethod
    def _has_a_batch_axis(cls, shape: tuple[int, ...]) -> tuple[int, ...]:
        if not shape or shape[0] != -1 or any(size < 1 for size in shape[1:]):
            raise ValueError(f"expected -1 for the batch, then positive sizes, got {list(shape)}")
        return shape


class StateSpec(_Model):
    """A policy's memory: graph input `state_in.<name>`, output `state_out.<name>`; `initial` starts an episode."""

    name: str
    dtype: str
    shape: Shape = Field(description="Without the batch axis")
    initial: float | tuple[float, ...] = Field(0.0, description="One number, or one per element in row-major order")
    kind: Literal["recurrent", "frames", "previous_actions", "previous_rewards"] = Field(
        "recurrent",
        description="'previous_actions' holds the last actions' one-hot codes, oldest first: whoever acts otherwise "
        "than the graph's own `action` (exploring) writes that action's code into the end of it",
    )

    def initial_value(self, batch: int) -> NDArray[Any]:
        """Return the state at an episode's start, `[batch, *shape]`."""
        one = np.asarray(self.initial, self.dtype)
        one = one.reshape(self.shape) if one.ndim else np.full(self.shape, one)
        return np.repeat(one[None], batch, axis=0)


class Distribution(_Model):
    """How `action_dist_inputs` become an exploring action; the deterministic one is the graph's own `action`."""

    kind: Literal["diag_gaussian", "squashed_gaussian", "categorical", "multi_categorical", "multi"] = Field(
        description="'multi' has one part for each leaf of a nested action space, in the order of the graph's outputs: "
        "diag_gaussian for a box, categorical or multi_categorical for the others"
    )
    transform: Literal["none", "unsquash", "clip"] = Field(
        description="What RLlib does to a sample before env.step: 'unsquash' maps [-1, 1] to the bounds and clips, "
        "'clip' only clips, 'none' sends it as it is (discrete actions: adds the space's start). Box leaves that are "
        "not bounded on all sides are never unsquashed"
    )


class BakedStep(_Model):
    """One processing step inside the graph, in the order it is applied."""

    step: str = Field(description="For example 'mean_std_filter', 'one_hot', 'network', 'mode', 'unsquash', 'clip'")
    detail: str = Field("", description="A sentence for people")
    values: dict[str, Any] = Field(default_factory=dict, description="For example count, mean and std of a filter")


class Provenance(_Model):
    """Where the policy came from."""

    algorithm: str
    api_stack: Literal["new", "old"]
    module_id: str
    agents: tuple[str, ...] = Field(default=(), description="For which agents of a multi-agent environment")
    module_class: str
    checkpoint_sha256: str = Field(description="Hash over the checkpoint files that were read")
    training_iterations: int | None = None
    env_steps: int | None = None
    env_id: str | None = None
    env_config: dict[str, Any] = Field(default_factory=dict)
    ray_version: str
    torch_version: str
    rlservo_version: str
    exported_at: str = Field(description="UTC, ISO 8601")


class FormatParity(_Model):
    """The largest differences between one written format and RLlib's own pipeline."""

    max_abs: float = Field(ge=0.0)
    max_rel: float = Field(ge=0.0, description="Relative to the scale that the gate measures with")


class Parity(_Model):
    """How the export was proven equal to what RLlib itself would send to env.step."""

    reference: str
    samples: int = Field(ge=0)
    batch_sizes: tuple[Size, ...]
    rtol: Tolerance
    atol: Tolerance
    rule: str = Field(default="", description="How the two tolerances are applied")
    formats: dict[str, FormatParity]


class Evaluation(_Model):
    """One closed-loop run of exported policy and checkpoint on the same seeds."""

    env_id: str
    episodes: Size
    first_seed: int
    return_bundle: float
    return_checkpoint: float
    success_rate_bundle: float | None
    success_rate_checkpoint: float | None
    evaluated_at: str


class Contract(_Model):
    """`contract.json`: everything a client, a server or a person needs to know of a policy."""

    schema_version: Literal[1] = 1
    name: str = Field(pattern=NAME_PATTERN)
    version: str = Field(pattern=VERSION_PATTERN)
    description: str = ""
    observation_space: SpaceSpec
    action_space: SpaceSpec
    inputs: tuple[TensorSpec, ...]
    outputs: tuple[TensorSpec, ...]
    state: tuple[StateSpec, ...] = ()
    distribution: Distribution | None
    baked_in: tuple[BakedStep, ...]
    control_rate_hz: float | None = Field(None, gt=0.0, description="The rate the environment asks for actions at")
    provenance: Provenance
    parity: Parity
    evaluations: tuple[Evaluation, ...] = ()


@dataclass(frozen=True)
class BundleLimits:
    """How large a bundle's files may be; larger ones are refused before they are read. A server sets its own."""

    max_policy_bytes: int | None = None
    """Of each file but the two below; None is no limit."""

    max_golden_bytes: int = 512 << 20
    """Of golden.npz, packed and unpacked."""

    max_contract_bytes: int = 16 << 20

    def of(self, name: str) -> tuple[int | None, str]:
        """Return (bytes, name of the limit) for a file of a bundle."""
        if name == CONTRACT_FILE:
            return self.max_contract_bytes, "max_contract_bytes"
        if name == GOLDEN_FILE:
            return self.max_golden_bytes, "max_golden_bytes"
        return self.max_policy_bytes, "max_policy_bytes"


DEFAULT_LIMITS = BundleLimits()


@dataclass(frozen=True)
class Bundle:
    """A bundle folder whose hashes have been checked, and its contract."""

    path: Path
    contract: Contract
    sums: Mapping[str, str]
    """The SHA-256 of each file, as recorded."""
    digest: str
    """What tells this bundle from every other: the hash of its hashes."""
    limits: BundleLimits = DEFAULT_LIMITS

    @property
    def onnx(self) -> Path:
        return self.path / ONNX_FILE

    @property
    def torchscript(self) -> Path:
        return self.path / TORCHSCRIPT_FILE

    def golden(self) -> tuple[dict[str, NDArray[Any]], dict[str, NDArray[Any]]]:
        """Return the golden (inputs, outputs) by tensor name; all share the leading batch axis.

        Raises BundleError, and BundleTamperedError where the file is no longer the one that was checked.
        """
        inputs: dict[str, NDArray[Any]] = {}
        outputs: dict[str, NDArray[Any]] = {}
        file = self.path / GOLDEN_FILE
        content = io.BytesIO(b"".join(_verified(file, self.sums[GOLDEN_FILE], self.limits)))
        try:
            _check_unpacked(file, content, self.limits.max_golden_bytes)
            with np.load(content, allow_pickle=False) as archive:
                for key in archive.files:
                    side, _, name = key.partition("/")
                    (inputs if side == "input" else outputs)[name] = archive[key]
        except BAD_ARCHIVE as error:
            raise BundleError(f"{file} cannot be read: {error}") from error
        return inputs, outputs

    @contextmanager
    def verified_copy(self, name: str) -> Iterator[Path]:
        """Give the path of a copy of a file which nobody else can change: the very bytes whose hash was compared.

        On Linux it is in no folder and gone with this process. Raises BundleError, BundleTamperedError.
        """
        with _private_file() as (copy, path):
            try:
                for block in _verified(self.path / name, self.sums[name], self.limits):
                    copy.write(block)
                copy.flush()
            except OSError as error:  # of writing: BundleError is none
                raise BundleError(
                    f"{self.path / name} cannot be copied to {tempfile.gettempdir()}: {error.strerror}"
                ) from error
            yield path


def load_bundle(path: str | Path, limits: BundleLimits = DEFAULT_LIMITS) -> Bundle:
    """Read and check one bundle.

    `path` may be the bundle folder itself, a policy folder `<name>/` (its newest version) or a repository that holds
    exactly one policy.

    Raises BundleError when there is no bundle, a file is missing or the contract is malformed, and
    BundleTamperedError when a file differs from its recorded hash.
    """
    folder = resolve_bundle(path)
    digest, sums = _read_sums(folder)
    for name in (ONNX_FILE, TORCHSCRIPT_FILE, CONTRACT_FILE, GOLDEN_FILE):
        if name not in sums:
            raise BundleError(f"{folder / SUMS_FILE} does not list {name}: the bundle is incomplete")
    if len(sums) > MAX_FILES:  # each may be as large as a policy, and all of them are hashed
        raise BundleError(f"{folder / SUMS_FILE} lists {len(sums)} files: at most {MAX_FILES}")
    contract = b""
    for name, recorded in sums.items():
        content = _verified(folder / name, recorded, limits)
        if name == CONTRACT_FILE:
            contract = b"".join(content)
        else:
            for _ in content:
                pass
    return Bundle(folder, _parse_contract(folder / CONTRACT_FILE, contract), sums, digest, limits)


def resolve_bundle(path: str | Path) -> Path:
    """Return the one bundle folder that `path` means: itself, its newest version, or its only policy's newest."""
    newest: dict[Path, Path] = {}
    for folder in find_bundles(path):  # versions of one policy come in ascending order
        newest[folder.parent] = folder
    if len(newest) > 1:
        names = ", ".join(sorted(str(folder.relative_to(path).parent) for folder in newest.values()))
        raise BundleError(f"{path} holds {len(newest)} policies ({names}): name one of their folders")
    return next(iter(newest.values()))


def find_bundles(path: str | Path) -> list[Path]:
    """Return every bundle folder at or below `path` (a bundle, a policy folder or a repository), oldest version first.

    Raises BundleError when there is none.
    """
    root = Path(path)
    if not root.exists():
        raise BundleError(f"{root} does not exist: expected a policy bundle (a folder with {CONTRACT_FILE})")
    if not root.is_dir():
        raise BundleError(f"{root} is a file: expected a policy bundle (a folder with {CONTRACT_FILE})")
    if _looks_like_bundle(root):
        return [root]
    versions = _versions(root)
    if not versions:
        versions = [v for policy in sorted(root.iterdir()) if policy.is_dir() for v in _versions(policy)]
    if not versions:
        raise BundleError(
            f"{root} holds no policy bundle: expected {CONTRACT_FILE} in it, in <version>/ or in <name>/<version>/"
        )
    return versions


def _looks_like_bundle(folder: Path) -> bool:
    return (folder / CONTRACT_FILE).exists() or (folder / SUMS_FILE).exists()


def _versions(policy: Path) -> list[Path]:
    folders = [
        f for f in policy.iterdir() if f.is_dir() and re.fullmatch(VERSION_PATTERN, f.name) and _looks_like_bundle(f)
    ]
    return sorted(folders, key=lambda f: version_key(f.name))


def version_key(version: str) -> tuple[int, ...]:
    """Return a sort key: '3' counts as 3.0.0."""
    parts = tuple(int(part) for part in version.split("."))
    return parts + (0,) * (3 - len(parts))


def read_contract(folder: Path, limits: BundleLimits = DEFAULT_LIMITS) -> Contract:
    """Parse `contract.json`; say in one sentence which field is wrong."""
    file = folder / CONTRACT_FILE
    return _parse_contract(file, b"".join(_blocks(file, *limits.of(CONTRACT_FILE))))


def _parse_contract(file: Path, content: bytes) -> Contract:
    try:
        return Contract.model_validate_json(content.decode("utf-8"))
    except UnicodeDecodeError as error:
        raise BundleError(f"{file} cannot be read: {error}") from error
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = ".".join(str(part) for part in first["loc"]) or "the document"
        raise BundleError(f"{file}: {where}: {first['msg']}") from error


def digest_of(folder: Path) -> str:
    """Return what tells a bundle from every other: the hash of its hashes. Raises BundleError."""
    return _read_sums(folder)[0]


def _read_sums(folder: Path) -> tuple[str, dict[str, str]]:
    """Return (the hash of SHA256SUMS, what it records by file name)."""
    file = folder / SUMS_FILE
    content = b"".join(_blocks(file, MAX_SUMS_BYTES))
    try:
        lines = content.decode("ascii").splitlines()
    except UnicodeDecodeError as error:
        raise BundleError(f"{file} cannot be read: {error}") from error
    sums: dict[str, str] = {}
    for number, line in enumerate(lines, start=1):
        match = re.fullmatch(r"([0-9a-f]{64})  ([A-Za-z0-9._-]+)", line)
        if match is None:
            raise BundleError(f"{file}, line {number}: expected '<sha256>  <file name>'")
        sums[match[2]] = match[1]
    return hashlib.sha256(content).hexdigest(), sums


def _verified(file: Path, recorded: str, limits: BundleLimits) -> Iterator[bytes]:
    """Yield a file's content; after the last of it raise BundleTamperedError where its hash is not the recorded one."""
    actual = hashlib.sha256()
    for block in _blocks(file, *limits.of(file.name)):
        actual.update(block)
        yield block
    if actual.hexdigest() != recorded:
        raise BundleTamperedError(
            f"{file} is not the file that was exported: its sha256 is {actual.hexdigest()[:12]}..., "
            f"{SUMS_FILE} records {recorded[:12]}...",
            {"file": file.name, "expected": recorded, "actual": actual.hexdigest()},
        )


def _blocks(file: Path, max_bytes: int | None, limit: str = "") -> Iterator[bytes]:
    """Yield a file's content; `limit` is what `max_bytes` is called. Raises BundleError."""
    try:
        with open_regular(file, max_bytes) as stream:
            yield from blocks(stream, max_bytes)
    except FileNotFoundError as error:
        raise BundleError(f"{file} is missing: the bundle is incomplete") from error
    except FileTooLargeError as error:
        raise BundleError(f"{file} {error}{f' ({limit})' if limit else ''}") from error
    except NotReadableError as error:
        raise BundleError(f"{file} {error}") from error
    except OSError as error:
        raise BundleError(f"{file} cannot be read: {error.strerror}") from error


def _check_unpacked(file: Path, content: io.BytesIO, max_bytes: int) -> None:
    """Refuse an archive whose arrays are larger than they may be, or than what is packed of them."""
    with zipfile.ZipFile(content) as archive:
        size = sum(member.file_size for member in archive.infolist())
        if size > max_bytes:
            raise BundleError(f"{file} unpacks to {size:,} bytes: at most {max_bytes:,} (max_golden_bytes)")
        for member in archive.infolist():
            with archive.open(member) as stream:
                version = np.lib.format.read_magic(stream)
                read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
                shape, _, dtype = read(stream)
            if math.prod(shape) * dtype.itemsize > member.file_size:
                raise BundleError(f"{file}: '{member.filename}' says that it is of shape {shape} and holds less")
    content.seek(0)


@contextmanager
def _private_file() -> Iterator[tuple[IO[bytes], Path]]:
    """Give an empty file for this process alone, and the path under which this process can open it."""
    if DESCRIPTORS.is_dir():
        with tempfile.TemporaryFile() as unnamed:
            yield unnamed, DESCRIPTORS / str(unnamed.fileno())
    else:
        with tempfile.TemporaryDirectory(prefix="rlservo-") as folder, (Path(folder) / "copy").open("wb") as named:
            yield named, Path(folder) / "copy"


def write_golden(folder: Path, inputs: Mapping[str, NDArray[Any]], outputs: Mapping[str, NDArray[Any]]) -> None:
    """Write golden.npz; every array's first axis is the sample."""
    arrays = {f"input/{name}": value for name, value in inputs.items()}
    arrays.update({f"output/{name}": value for name, value in outputs.items()})
    # `allow_pickle` would be one more array to numpy before 2.1; load_bundle refuses pickled ones.
    np.savez_compressed(folder / GOLDEN_FILE, **arrays)  # type: ignore[arg-type]  # for numpy 2's keyword above


def write_contract(folder: Path, contract: Contract) -> None:
    """Write contract.json and, with it, SHA256SUMS over all four files, of which the other three must exist.

    Both are written beside the old ones and then take their names: whatever fails before leaves the bundle as it was.
    """
    with tempfile.TemporaryDirectory(prefix=".contract-", dir=folder) as name:
        beside = Path(name)
        (beside / CONTRACT_FILE).write_text(contract_json(contract) + "\n", encoding="utf-8")
        files = [beside / CONTRACT_FILE, *(folder / other for other in (GOLDEN_FILE, ONNX_FILE, TORCHSCRIPT_FILE))]
        sums = "".join(f"{sha256(file)}  {file.name}\n" for file in files)
        (beside / SUMS_FILE).write_text(sums, encoding="ascii")
        for file in (CONTRACT_FILE, SUMS_FILE):
            (beside / file).replace(folder / file)


def embedded_contract(text: str, where: Path) -> Contract:
    """Parse the copy of the contract that the graph's metadata hold under CONTRACT_KEY."""
    try:
        return Contract.model_validate_json(text)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        raise BundleError(f"{where}: the contract inside it is malformed: {first['msg']}") from error


def contract_json(contract: Contract) -> str:
    """Return the contract as the indented JSON that goes into the bundle and the ONNX metadata."""
    return json.dumps(contract.model_dump(mode="json"), indent=2)


def sha256(file: Path) -> str:
    """Return the file's hash as 64 hexadecimal digits."""
    digest = hashlib.sha256()
    with file.open("rb") as stream:
        for block in iter(lambda: stream.read(1 << 20), b""):
            digest.update(block)
    return digest.hexdigest()


def iter_elements(space: LeafSpec) -> Iterator[tuple[int, str]]:
    """Yield (index, label) for error messages: the element's name where known, else its index."""
    for index in range(space.size):
        named = index < len(space.elements)
        yield index, f"{index} ({space.elements[index].name})" if named else str(index)
