"""The page of a dataset, in a real browser too, and where it cannot be made."""

import json
import shutil

import pytest
from commands import open_in_browser
from PIL import Image, ImageSequence

from dynmap_rl.reporting import dataset_page
from dynmap_rl.reporting.dataset_page import write_dataset_page


@pytest.mark.slow
def test_it_is_whole_in_a_browser(recording, tmp_path, capsys):
    write_dataset_page(tmp_path / "page", recording, {"task": "balance_reaching"}, "python x.py", "said")
    page = tmp_path / "page/report.html"
    assert capsys.readouterr().out == f"written: {page}\n"
    seen = open_in_browser(page, tmp_path / "page.png")
    assert seen["loaded"] and seen["requests"] == [page.as_uri()] and seen["console"] == []
    assert len(seen["images"]) == 2 and min(seen["images"]) > 500, (
        "four episodes side by side, and the curves"
    )
    for said in ("6 episodes (train 0:4, eval 4:6), 720 frames, 20 a second", "said", "balance_reaching"):
        assert said in seen["text"]


def test_a_film_has_few_frames(recording, tmp_path, monkeypatch):
    frames, shown = 50, 40  # every third frame of 120
    monkeypatch.setattr(dataset_page, "FRAMES", frames)
    write_dataset_page(tmp_path, recording, {}, "")
    film = Image.open(tmp_path / "episodes.gif")
    durations = [frame.info["duration"] for frame in ImageSequence.Iterator(film)]
    assert sum(durations) == 150 * shown, "what does not move is one frame that lasts"


def test_numbers_that_a_dataset_lacks_are_left_open(recording, tmp_path):
    shutil.copytree(recording, tmp_path / "dataset")
    path = tmp_path / "dataset/meta/info.json"
    info = json.loads(path.read_text())
    del info["total_episodes"], info["fps"]
    path.write_text(json.dumps(info))
    write_dataset_page(tmp_path / "page", tmp_path / "dataset", {}, "")
    assert (
        "? episodes (train 0:4, eval 4:6), 720 frames, ? a second"
        in (tmp_path / "page/report.html").read_text()
    )


def test_where_there_can_be_no_page_the_reason_is_printed(recording, tmp_path, capsys):
    """The dataset is done then, and what follows, such as its upload, is not to be lost."""
    (tmp_path / "file").write_text("")
    write_dataset_page(tmp_path / "file/page", recording, {}, "")
    assert capsys.readouterr().out.startswith(f"no page in {tmp_path / 'file/page'}: ")
    shutil.copytree(recording, tmp_path / "dataset")
    for file in (tmp_path / "dataset/data").glob("*/*.parquet"):
        file.write_bytes(file.read_bytes()[:1000])
    write_dataset_page(tmp_path / "page", tmp_path / "dataset", {}, "")
    assert str(tmp_path / "page") in capsys.readouterr().out
    assert not (tmp_path / "page/report.html").exists()
