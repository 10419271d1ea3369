import pytest

from dynmap_rl.modules.supervision import parse_supervision, row_name


@pytest.mark.parametrize(
    ("text", "quantities", "row"),
    [
        ("none", (), "Only-RGB"),
        ("", (), "Only-RGB"),
        ("velocity, position", ("position", "velocity"), "RGB+[P+V]"),
        ("acceleration", ("acceleration",), "RGB+[A]"),
    ],
)
def test_supervision_is_in_the_papers_order(text, quantities, row):
    assert parse_supervision(text) == quantities
    assert row_name(quantities) == row_name(quantities, "joint") == row


def test_end_to_end_has_a_row_of_its_own():
    assert row_name(("position",), "end_to_end") == "End-to-End"


def test_unknown_quantities_are_refused():
    with pytest.raises(ValueError, match="jerk"):
        parse_supervision("position,jerk")
