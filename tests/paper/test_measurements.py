"""Tables of measurements beside the cells."""

from dynmap_rl.paper.measurements import markdown_ablations, markdown_perception


def test_perception_is_a_row_for_each_model_and_dataset():
    found = {"object_error": 0.1, "chroma_explained": 0.8, "goal_explained": 0.9, "background_error": 0.05}
    places = dict.fromkeys(("held-out demonstrations", "first ten steps"), found | {"cart_error": 0.012})
    probe = {
        "perception": {"RGB+[P], decoupled": places, "Only-RGB, decoupled": places},
        "open_loop": {"RGB+[P], decoupled": {"model": {"cart_mm": [1, 8.44], "block_mm": [2, 9.0]}}},
    }
    lines = markdown_perception(probe).splitlines()[2:]
    assert lines[0] == (
        "| RGB+[P], decoupled | held-out demonstrations | 0.10 | 0.80 | 0.90 | 0.05 | 12.0 mm | 8.4 mm, 9.0 mm |"
    )
    assert len(lines) == 4 and all(line.endswith("| 12.0 mm |  |") for line in lines[1:])


def test_ablations_are_rows_with_and_without_a_world_model_of_their_own():
    seen = {"object_error": 0.1, "chroma_explained": 0.8, "goal_explained": 0.9, "background_error": 0.05}
    late = {"SR": 93.2, "SR_interval": [90.6, 95.1], "DR": 0.0}
    models = {"default": seen | {"cart_error": 0.012, "cart_mm": 8.4, "block_mm": 9.0}}
    lines = markdown_ablations({"late": {"default": late, "a": late}, "world_models": models}).splitlines()
    assert (
        lines[2]
        == "| default | 0.0 | **93.2** [90.6, 95.1] | 0.10 | 0.80 | 0.90 | 0.05 | 12.0 mm | 8 mm, 9 mm |"
    )
    assert lines[3].startswith("| a | 0.0 | **93.2** [90.6, 95.1] |  |") and len(lines) == 4
    assert len({line.count("|") for line in lines}) == 1
