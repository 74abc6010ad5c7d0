"""The kernel that OpenBLAS multiplies with: a fast one is chosen, and the bits stay the same."""

import os
import subprocess
import sys

import numpy as np
import pytest
from conftest import HEARTHLOG, spread_files

from hearthlog.schemas import blas
from hearthlog.schemas.blas import kernel_environment
from hearthlog.schemas.logs.columns import read_columns
from hearthlog.schemas.logs.files import find_logs

COMPARED = {
    "/mic/features": ["values"],
    "/mic/statistics": ["mean", "std"],
    "/mic/label": ["label", "confidence", "novelty", "probabilities"],
    "/mic/segment": ["header.stamp", "duration", "label", "confidence"],
}
KERNELS = {
    "Prescott": "pni",
    "Nehalem": "sse4_2",
    "Sandybridge": "avx",
    "Haswell": "avx2",
    "SkylakeX": "avx512bw",
}


@pytest.fixture
def processor(tmp_path, monkeypatch):
    """A processor that can do this."""

    def pretend(flags):
        path = tmp_path / "cpuinfo"
        path.write_text(f"processor\t: 0\nflags\t\t: fpu {flags} lm\n")
        monkeypatch.setattr(blas, "_CPU", path)
        monkeypatch.delenv("OPENBLAS_CORETYPE", raising=False)

    return pretend


def test_a_processor_with_avx_512_uses_it(processor):
    processor("avx2 avx512f avx512bw avx512cd avx512dq avx512vl")
    assert kernel_environment() == {"OPENBLAS_CORETYPE": "SkylakeX"}


def test_a_processor_with_a_part_of_it_is_left_alone(processor):
    processor("avx2 avx512f avx512cd")
    assert kernel_environment() == {}


def test_the_choice_of_the_user_stands(processor, monkeypatch):
    processor("avx2 avx512f avx512bw avx512cd avx512dq avx512vl")
    monkeypatch.setenv("OPENBLAS_CORETYPE", "Haswell")
    assert kernel_environment() == {}


def test_a_system_without_such_a_file_is_left_alone(processor, tmp_path, monkeypatch):
    processor("")
    monkeypatch.setattr(blas, "_CPU", tmp_path / "none")
    assert kernel_environment() == {}


def test_the_command_multiplies_with_the_kernel_that_is_chosen():
    script = (
        "from hearthlog.tools.cli import main\n"
        "import numpy\n"
        "from hearthlog.analyzer.workers import kernel_in_use\n"
        "print(kernel_in_use())"
    )
    environment = {n: v for n, v in os.environ.items() if n != "OPENBLAS_CORETYPE"}
    output = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True, env=environment
    ).stdout.strip()
    if not output.startswith("openblas"):
        pytest.skip("numpy multiplies with another library here")
    assert output == "openblas SkylakeX" or not kernel_environment()


def runnable():
    """Kernels that this processor can run."""
    flags = blas._flags()
    return [kernel for kernel, flag in KERNELS.items() if flag in flags]


def test_whatever_the_kernel_features_and_labels_have_the_same_bits(household, tmp_path):
    if len(runnable()) < 2:
        pytest.skip("only one kernel runs here")
    files = map(str, spread_files(household, 40))
    sound = [*files, "--start", "2026-03-01T07:00", "--model", "general"]
    columns = []
    for kernel in runnable():
        command = [*HEARTHLOG, "record", *sound, "-o", str(tmp_path / kernel)]
        subprocess.run(command, check=True, env=os.environ | {"OPENBLAS_CORETYPE": kernel})
        columns.append(read_columns(find_logs(tmp_path / kernel), COMPARED))
    one = columns[0]
    assert min(map(len, one.values())) > 30
    for other in columns[1:]:
        for topic, fields in COMPARED.items():
            for field in fields:
                np.testing.assert_array_equal(one[topic][field], other[topic][field])
