from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from make_sequences import names

from kornia_learnnorm.data.datasets.frames import Frame
from kornia_learnnorm.data.datasets.pairing import choose_pairs, listed_pairs, pair_frames


def numbered(*sequences: str) -> list[Frame]:
    return [Frame(Path(), f"{sequence}/{n}.png", sequence, (640, 480)) for sequence in sequences for n in range(4)]


class TestPairFrames:
    @given(gap=st.integers(1, 6))
    def test_gap_within_a_sequence(self, gap):
        expected = [(f"{s}/{n}.png", f"{s}/{n + gap}.png") for s in "xy" for n in range(4 - gap)]
        assert names(pair_frames(numbered("x", "y"), gap)) == expected

    def test_wrong_gap(self):
        with pytest.raises(ValueError, match="at least 1, got 0"):
            list(pair_frames(numbered("x"), 0))

    def test_all_pairs(self):
        pairs, text = choose_pairs(numbered("x", "y"), gap=None)
        assert text == "all pairs"
        assert len({frozenset(both) for both in names(pairs)}) == len(pairs) == 8 * 7 / 2


class TestListedPairs:
    def test_order_of_the_lines(self, tmp_path):
        (tmp_path / "pairs.txt").write_text("# hloc\nx/3.png  x/0.png\n\nx/1.png\ty/2.png\n")
        pairs = listed_pairs(numbered("x", "y"), str(tmp_path / "pairs.txt"))
        assert names(pairs) == [("x/3.png", "x/0.png"), ("x/1.png", "y/2.png")]

    def test_malformed(self, tmp_path):
        for text, message in [
            ("x/0.png x/1.png\nx/0.png\n", r"pairs\.txt, line 2: two names of two images expected, got 'x/0\.png'"),
            ("x/0.png x/0.png", r"line 1: two names of two images expected"),
            ("x/0.png x/1.png\nx/1.png x/0.png\n\nx/0.png  x/1.png", r"line 4: .* is in line 1 already"),
            ("\nx/0.png 7.png", r"line 2: no frame '7\.png' among 4, such as 'x/0\.png'"),
        ]:
            (tmp_path / "pairs.txt").write_text(text)
            with pytest.raises(ValueError, match=message):
                list(listed_pairs(numbered("x"), tmp_path / "pairs.txt"))
