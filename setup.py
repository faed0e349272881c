"""Build steps beyond pyproject.toml: one .pth file at the top of site-packages (see envs/discovery.py)."""

from __future__ import annotations

import base64
import hashlib
import shutil
import zipfile
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py
from setuptools.command.editable_wheel import editable_wheel

PTH = Path("envs") / "rlservo-gymnasium.pth"


class BuildWithPth(build_py):
    """Puts the .pth file beside the packages in an ordinary wheel."""

    def run(self) -> None:
        super().run()
        if not self.editable_mode:
            Path(self.build_lib).mkdir(parents=True, exist_ok=True)
            self.copy_file(str(PTH), str(Path(self.build_lib) / PTH.name))

    def get_outputs(self, include_bytecode: bool = True) -> list[str]:
        own = [] if self.editable_mode else [str(Path(self.build_lib) / PTH.name)]
        return super().get_outputs(include_bytecode) + own


class EditableWithPth(editable_wheel):
    """Adds the .pth file to the wheel of an editable install, which holds no package files."""

    def run(self) -> None:
        super().run()
        wheels = sorted(Path(self.dist_dir).glob("*.whl"), key=lambda file: file.stat().st_mtime)
        add_to_wheel(wheels[-1], PTH)


def add_to_wheel(wheel: Path, file: Path) -> None:
    """Write `file` into the wheel's root and its RECORD."""
    content = file.read_bytes()
    digest = base64.urlsafe_b64encode(hashlib.sha256(content).digest()).rstrip(b"=").decode()
    rewritten = wheel.with_suffix(".tmp")
    with zipfile.ZipFile(wheel) as old, zipfile.ZipFile(rewritten, "w", zipfile.ZIP_DEFLATED) as new:
        for item in old.infolist():
            data = old.read(item)
            if item.filename.endswith(".dist-info/RECORD"):
                data = f"{file.name},sha256={digest},{len(content)}\n".encode() + data
            new.writestr(item, data)
        new.writestr(file.name, content)
    shutil.move(rewritten, wheel)


setup(cmdclass={"build_py": BuildWithPth, "editable_wheel": EditableWithPth})
