"""What pyproject.toml cannot say: conf/, which lies beside the package in a clone, goes into a wheel as mosa/conf."""

from pathlib import Path
from shutil import copytree, rmtree

from setuptools import setup
from setuptools.command.build_py import build_py


class BuildWithConfiguration(build_py):
    def run(self) -> None:
        super().run()
        if not self.editable_mode:
            inside = Path(self.build_lib) / "mosa" / "conf"
            rmtree(
                inside, ignore_errors=True
            )  # of an earlier build, with what has been removed since
            copytree("conf", inside)


setup(cmdclass={"build_py": BuildWithConfiguration})
