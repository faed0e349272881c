"""C of a policy on other compilers and processors: its self-test, under sanitizers, and with random bits."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from rlservo.export.compiled.compile import Compiled

TARGETS = Path(__file__).with_name("targets")
WARNINGS = ["-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Werror"]
SANITIZERS = ["-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
CORTEX_M4 = ["-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16", "--specs=rdimon.specs"]


def need(*tools: str) -> None:
    for tool in tools:
        if shutil.which(tool) is None:
            pytest.skip(f"there is no {tool} (.ci/run lists Debian's packages)")


def run(*command: object, folder: Path) -> str:
    done = subprocess.run([*map(str, command)], cwd=folder, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def self_test(folder: Path, program: Path, *compiler: object, then: tuple[object, ...] = ()) -> str:
    """Compile a policy's self-test without a warning, and run it."""
    sources = [folder / "ur5_test.c", folder / "ur5.c"]
    run(*compiler, "-std=c99", *WARNINGS, *sources, "-o", program, "-lm", folder=folder)
    return run(*then, program, folder=program.parent)


@pytest.mark.parametrize(
    ("compiler", "options", "runner"),
    [
        ("clang", ["-O2"], []),
        ("gcc", ["-O1", *SANITIZERS], []),
        ("arm-linux-gnueabihf-gcc", ["-O2", "-static"], ["qemu-arm"]),
        ("clang", ["--target=wasm32-wasi", "-O2"], ["node", "--no-warnings", TARGETS / "run_wasi.mjs"]),
    ],
    ids=["clang", "sanitizers", "32-bit ARM", "WebAssembly"],
)
def test_golden_vectors_are_reproduced(
    compiled_ur5: Compiled, tmp_path: Path, compiler: str, options: list[str], runner: list[object]
) -> None:
    need(compiler, *(str(tool) for tool in runner[:1]))
    if "wasm32" in options[0] and not Path("/usr/lib/wasm32-wasi/libm.a").exists():
        pytest.skip("there is no wasi-libc (.ci/run lists Debian's packages)")
    said = self_test(compiled_ur5.folder, tmp_path / "test", compiler, *options, then=tuple(runner))
    assert "8 of 8 vectors" in said and "reproduced" in said


def test_golden_vectors_are_reproduced_on_a_microcontroller(compiled_ur5: Compiled, tmp_path: Path) -> None:
    need("arm-none-eabi-gcc", "qemu-system-arm")
    machine = ["qemu-system-arm", "-M", "mps2-an386", "-nographic", "-semihosting", "-kernel"]
    start = [TARGETS / "cortex_m.c", "-nostartfiles", "-T", TARGETS / "cortex_m.ld"]
    compiler = ["arm-none-eabi-gcc", "-O2", *CORTEX_M4, *start]
    assert "reproduced" in self_test(compiled_ur5.folder, tmp_path / "test", *compiler, then=tuple(machine))


def test_the_self_test_finds_a_wrong_weight(compiled_ur5: Compiled, tmp_path: Path) -> None:
    need("cc")
    source = (compiled_ur5.folder / "ur5.c").read_text()
    at = source.index("ALIGNED = {\n    ", source.index("weights_")) + len("ALIGNED = {\n    ")
    (tmp_path / "ur5.c").write_text(f"{source[:at]}0x1p+3f, {source[source.index(', ', at) + 2 :]}")
    for name in ("ur5.h", "ur5_test.c"):
        shutil.copy(compiled_ur5.folder / name, tmp_path)
    run("cc", "-std=c99", "ur5_test.c", "ur5.c", "-o", "test", "-lm", folder=tmp_path)
    done = subprocess.run([tmp_path / "test"], capture_output=True, text=True)
    assert done.returncode == 1
    assert "vector 0, action, element 0" in done.stdout


def test_random_bits_are_refused_or_give_an_action_of_the_space(compiled_ur5: Compiled, tmp_path: Path) -> None:
    need("gcc")
    names = {"OBS": "obs", "STATE": "state", "ACTION": "action", "RESET": "reset", "ACT": "act", "ELEMENT": "element"}
    defined = [*(f"-D{key}=ur5_{name}" for key, name in names.items()), "-DREFUSED=UR5_REFUSED", "-DLOW=-2", "-DHIGH=2"]
    header = '-DPOLICY_HEADER="ur5.h"'
    sources = [TARGETS / "fuzz.c", compiled_ur5.folder / "ur5.c"]
    command = ["gcc", "-std=c99", "-O1", *SANITIZERS, *defined, header, f"-I{compiled_ur5.folder}", *sources]
    run(*command, "-o", "fuzz", "-lm", folder=tmp_path)
    assert "refused" in run(tmp_path / "fuzz", folder=tmp_path)


def test_the_header_serves_a_cpp_program(compiled_ur5: Compiled, tmp_path: Path) -> None:
    need("gcc", "g++")
    (tmp_path / "main.cpp").write_text(
        '#include <cstdio>\n#include "ur5.h"\nint main() {\n'
        "    static ur5_obs obs;\n    static ur5_state state;\n    static ur5_action action;\n"
        "    ur5_reset(&state);\n    obs.values[UR5_OBS_ELEMENT_3] = 1.0e30F;\n"
        "    obs.values[UR5_OBS_ELEMENT_3] *= 1.0e30F;\n"
        "    const auto code = ur5_act(&obs, &state, &action);\n"
        '    std::printf("%d %s\\n", static_cast<int>(UR5_KIND(code)), ur5_element(code));\n'
        "    return code == ((UR5_NOT_FINITE << 24) | UR5_OBS_ELEMENT_3) ? 0 : 1;\n}\n"
    )
    run("gcc", "-std=c99", "-c", compiled_ur5.folder / "ur5.c", folder=tmp_path)
    include = f"-I{compiled_ur5.folder}"
    run("g++", "-std=c++17", *WARNINGS, include, "main.cpp", "ur5.o", "-o", "program", "-lm", folder=tmp_path)
    assert run(tmp_path / "program", folder=tmp_path) == "2 element_3\n"
