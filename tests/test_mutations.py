"""Files that were changed in any way: no crash, no hang, and a word wherever values differ."""

import random

import pytest
from mutations import LABELLED, MUTATIONS, begin, write_files


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    return write_files(tmp_path_factory.mktemp("files"))


@pytest.mark.parametrize("name", ["live-finished", "zstd", "stored"])
def test_a_file_that_was_changed_in_any_way_gives_the_same_or_a_word(files, name, tmp_path):
    rng, path = random.Random(0), files[name]
    victim = begin(name, path, tmp_path / name)
    try:
        for mutation in MUTATIONS[:: 2 if name in LABELLED else 1]:
            output = victim.read(mutation(rng, path.read_bytes()), path.name)
            assert not output, (mutation.__name__, output)
    finally:
        victim.close()
