"""Frozen recipes, and releases made of them."""

import json
import os
import re
import shutil
import stat
import tarfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from helpers.small_release import SMALL, STARTER, Made, ask, flip, snapshot

from phibench.benchmark.export.export_make import export_frames_sets
from phibench.benchmark.pair_sets.frames_set import FramesSet
from phibench.benchmark.release.release_make import ReleaseRequest, _card, _misfit, forecast_lines, release
from phibench.benchmark.release.release_parts import PARTS, VERSION, ReleasePart, content_sha256
from phibench.benchmark.release.release_source import SOURCE
from phibench.benchmark.scored_dataset import open_dataset
from phibench.benchmark.sealed.sealed_set import seal
from phibench.cli.main import main
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.plan.plan import make_plan
from phibench.datasets.recipe.load import parse_recipe, recipe_text, with_numbers
from phibench.datasets.store.checksums import damaged_files, differing_files, read_checksums
from phibench.datasets.store.metadata import read_manifest

ROOT = Path(__file__).parents[3]
SECRET = 2**128 + 12345


# The frozen recipes.


def test_frozen_recipes_are_unchanged() -> None:
    """The hashes stand in the code; a change of a number in a recipe needs a new version, a comment does not."""
    names = ["dev", "test", "paper", "mirrors", "films", "drives", "dense-dev", "dense-test", "starter"]
    assert [part.name for part in PARTS] == names
    for part in PARTS:
        assert content_sha256(part.text()) == part.sha256
        assert part.title == f"phibench-v4-{part.name}"


@pytest.mark.slow
def test_frozen_samples_are_unchanged() -> None:
    """What the code draws from the frozen recipe of the open set; 1e-6 m is more than libraries of sines differ by."""
    plan = make_plan(parse_recipe(with_numbers(recipe_text("bench-dev"), "bench-dev", 4, None)))
    expected = {
        0: (0.550114925, (-4.965248958, 0.283741908, 0.109299339)),
        3: (1.170399890, (-0.266339945, -1.718236028, 3.819721291)),
    }
    for number, (stroke_m, spot_m) in expected.items():
        pair = plan.pairs[number]
        assert pair.stroke_m == pytest.approx(stroke_m, abs=1e-6)
        assert plan.spots[pair.spot].position_world_m == pytest.approx(spot_m, abs=1e-6)


def test_comments_do_not_count_and_numbers_do(tmp_path: Path) -> None:
    text = recipe_text("bench-dev")
    changed = tmp_path / "bench-dev.toml"
    changed.write_text("# another comment\n" + text.replace("  # 4 sigma", ""))
    part = ReleasePart("dev", changed, "pairs", PARTS[0].sha256)
    assert part.text()
    assert text.count("[0.25, 1.0]") == 1
    changed.write_text(text.replace("[0.25, 1.0]", "[0.25, 1.001]"))
    with pytest.raises(DatasetError, match=r"not the frozen one of version 4\.0"):
        part.text()


def test_the_page_has_the_versions_and_the_parts() -> None:
    page = (ROOT / "docs" / "release.md").read_text(encoding="utf-8")
    versions = re.findall(r"^\| (\d+\.\d+) \|", page.split("## Versions")[1], flags=re.MULTILINE)
    assert versions[0] == VERSION
    assert sorted(versions, reverse=True) == versions
    for part in PARTS:
        assert f"| `{part.title}` | `{part.recipe}`" in page


def test_citation_names_this_version() -> None:
    import tomllib

    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert (cited["cff-version"], cited["version"], cited["license"]) == ("1.2.0", project["version"], "MIT")
    assert {"message", "title", "authors", "type"} <= set(cited)
    data = next(one for one in cited["references"] if one["type"] == "data")
    assert (data["version"], data["license"]) == (VERSION, "CC-BY-4.0")


# Releases.


def test_card_says_how_many_of_how_many(made: Made) -> None:
    """A smaller release says so. The recipe's number is counted here from the frozen text alone."""
    dev = PARTS[0]
    assert re.findall(r"^samples = (\d+)$", dev.text(), flags=re.MULTILINE) == ["500"]
    whole = made.released.manifest.parts["phibench-v4-small"]
    assert whole.recipe_samples is None  # it draws none
    for samples, text in ((3, "3 of 500"), (500, "500")):
        part = whole.model_copy(update={"samples": samples, "recipe_samples": 500})
        card = _card("phibench-v4", made.released.manifest.model_copy(update={"parts": {dev.title: part}}))
        row = next(line for line in card.splitlines() if line.startswith(f"| `{dev.title}`"))
        assert row.split("|")[3].strip() == text


def test_refused_release_leaves_nothing(tmp_path: Path) -> None:
    request = ReleaseRequest(PARTS[:1], tmp_path / "o" / "public", tmp_path / "o" / "work", None, samples=0)
    with pytest.raises(DatasetError, match=r"random\.samples: 0 is not allowed"):
        release(request, seal)
    assert list(tmp_path.iterdir()) == []


def test_archives_hold_the_data_sets_and_no_secret(made: Made, smallest_dataset: Path, film_windows: Path) -> None:
    parts = made.released.manifest.parts
    assert {name: part.kind for name, part in parts.items()} == {
        "phibench-v4-small": "pairs",
        "phibench-v4-hidden": "sealed",
        "phibench-v4-films": "films",
        "phibench-v4-starter": "frames",
    }
    assert len(parts["phibench-v4-small"].archives) > 3
    assert differing_files(made.out, read_checksums(made.out)) == []
    for title, source in (("phibench-v4-small", smallest_dataset), ("phibench-v4-films", film_windows)):
        found = {}
        for archive in parts[title].archives:
            with tarfile.open(made.out / archive.name) as tar:
                for entry in tar:
                    assert (entry.uid, entry.gid, entry.uname, entry.mtime) == (0, 0, "", 315532800)
                    found[entry.name.removeprefix(f"{title}/")] = tar.extractfile(entry).read()  # type: ignore[union-attr]
        assert len(found) == parts[title].files
        assert found == {name: (source / name).read_bytes() for name in found}
        assert set(read_checksums(source)) < set(found)
    secret = made.request.secret_seed.read_text().strip()
    assert stat.S_IMODE(made.request.secret_seed.stat().st_mode) == 0o600
    assert int(secret) > 2**62
    truth = list((made.request.work / "phibench-v4-hidden").glob("seal_*.truth.json"))
    assert len(truth) == 1
    for path in made.out.iterdir():
        assert secret.encode() not in path.read_bytes()
        assert b"truth.json" not in path.read_bytes()


@pytest.mark.usefixtures("inline")
def test_the_same_again_keeps_all_and_elsewhere_has_the_same_bytes(made: Made, tmp_path: Path) -> None:
    again = release(made.request, seal)
    assert (again.made, again.kept) == (0, made.released.made)
    before = snapshot(made.out)
    shutil.copytree(made.request.work, tmp_path / "work")
    for path in (tmp_path / "work").rglob("*"):
        os.utime(path, (1e9, 1e9))
    for state in (tmp_path / "work").glob("*-archives"):
        shutil.rmtree(state)
    shutil.copy2(made.request.secret_seed, tmp_path / "seed")
    other = release(ask(tmp_path, list(made.request.parts), use=made.request.use), seal)
    assert other.made == made.released.made
    assert snapshot(other.out) == before


def test_a_run_that_was_killed_goes_on(made: Made, tmp_path: Path, smallest_dataset: Path) -> None:
    """Killed after some archives: one has a flipped bit, one is half there under a temporary name, one is missing."""
    request = ask(tmp_path, [SMALL], use=[smallest_dataset])
    first = release(request, seal)
    before = snapshot(first.out)
    names = sorted(path.name for path in first.out.glob("*.tar"))
    flip(first.out / names[0])
    (first.out / names[1]).unlink()
    (first.out / ".phibench-tmp-half0000.tar").write_bytes(b"half")
    (first.out / "SHA256SUMS").unlink()
    second = release(request, seal)
    assert (second.made, second.kept) == (2, len(names) - 2)
    assert snapshot(second.out) == before


def test_a_damaged_data_set_is_not_released(smallest_dataset: Path, tmp_path: Path) -> None:
    shutil.copytree(smallest_dataset, tmp_path / "set")
    flip(next((tmp_path / "set" / "spots").glob("*.exr")))
    for part in (SMALL, STARTER):
        with pytest.raises(DatasetError, match=r"spots/.* is damaged.*phibench dataset repair"):
            release(ask(tmp_path, [part], use=[tmp_path / "set"]), seal)
    assert not (tmp_path / "public" / "SHA256SUMS").exists()


def test_the_starter_part_takes_the_first_samples_of_dev(tmp_path: Path, smallest_dataset: Path) -> None:
    """It draws no data set of its own: dev's does, however many samples it has beyond those that are shown."""
    dev, starter = PARTS[0], PARTS[-1]
    assert (starter.rendered, starter.samples) == (dev.title, 60)
    asked = ReleaseRequest([starter], tmp_path / "public", tmp_path / "work", None)
    assert asked.frames_of(starter) == {"mjpeg": 60, "srgb8": 3, "bayer-raw": 3}
    fewer = replace(asked, samples=2)
    assert fewer.frames_of(starter) == {"mjpeg": 2, "srgb8": 2, "bayer-raw": 2}
    assert replace(asked, samples=5000).frames_of(starter) == asked.frames_of(starter)
    folder = tmp_path / "dev"
    folder.mkdir()
    for name in ("dataset.json", "SHA256SUMS"):
        shutil.copy2(smallest_dataset / name, folder)
    for samples, fits in ((59, []), (60, [starter.title]), (500, [dev.title, starter.title])):
        text = with_numbers(recipe_text("bench-dev"), "bench-dev", samples, None)
        (folder / "recipe.toml").write_text(text, encoding="utf-8")
        found = [part.title for part in (dev, starter) if not _misfit(asked, part, folder)]
        assert found == fits
    (folder / "recipe.toml").write_text(with_numbers(recipe_text("bench-dev"), "bench-dev", 60, None))
    assert "it has 60 samples, and phibench-v4-dev is to have 500" in _misfit(
        replace(asked, parts=[dev, starter]), starter, folder
    )
    first = next(iter(read_manifest(smallest_dataset)))
    sets = export_frames_sets(smallest_dataset, {"mjpeg": 1}, tmp_path / "sets", workers=1)
    [(pair, truth)] = FramesSet(sets / "mjpeg")
    drawn = open_dataset(smallest_dataset).pairs("mjpeg")
    assert truth.sample_id == first.sample_id
    rigs = [json.loads(line)["rig"] for line in (sets / "mjpeg" / "rigs.jsonl").read_text().splitlines()]
    assert set(rigs) == {first.rig, first.nominal_rig}
    assert np.array_equal(pair.up, drawn.pair(drawn.number_of(first.sample_id)).up)


def test_a_dry_run_says_sizes_and_writes_nothing(made: Made, tmp_path: Path) -> None:
    request = ask(tmp_path, list(made.request.parts), use=made.request.use)
    lines = list(forecast_lines(request))
    assert [line.split(":")[0] for line in lines] == [part.title for part in made.request.parts]
    assert all(re.search(r"\d+ MB", line) for line in lines)
    assert "CPU-hours" in lines[1]
    assert list(tmp_path.iterdir()) == []


def test_folders_and_seeds_that_will_not_do(made: Made, tmp_path: Path, smallest_dataset: Path) -> None:
    def told(**changes: Any) -> str:
        values = {"out": tmp_path / "public", "work": tmp_path / "work", "secret_seed": tmp_path / "seed", **changes}
        request = ReleaseRequest(changes.pop("parts", [SMALL]), **{k: v for k, v in values.items() if k != "parts"})
        with pytest.raises(DatasetError) as caught:
            release(request, seal)
        return str(caught.value)

    assert "part them" in told(work=tmp_path / "public" / "work")
    assert "to be published" in told(secret_seed=tmp_path / "public" / "seed")
    sealed = ReleasePart("sealed", SMALL.recipe, "sealed", SMALL.sha256)
    assert "is sealed: give --secret-seed" in told(secret_seed=None, parts=[sealed])
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine.txt").write_text("mine")
    assert "holds other files" in told(out=tmp_path / "full")
    assert (tmp_path / "full" / "mine.txt").read_text() == "mine"
    assert "no data set of a recipe" in told(use=[tmp_path / "full"])
    lacking = tmp_path / "lacking"
    shutil.copytree(smallest_dataset, lacking)
    left_out = [{"sample_id": "seen-near-h0.500", "cause": "a certificate"}]
    info = json.loads((lacking / "dataset.json").read_text()) | {"left_out": left_out}
    (lacking / "dataset.json").write_text(json.dumps(info))
    refused = "1 of its samples are refused and left out, such as seen-near-h0.500, and a release has all samples"
    assert refused in told(use=[lacking])
    sealed = ReleasePart("hidden", SMALL.recipe, "sealed", SMALL.sha256)  # the data set has the public seed
    for number, mode, expected in (
        (SECRET, 0o600, "seed is not the one"),
        (SECRET, 0o644, "chmod 600"),
        (2**64, 0o600, "2^128"),
        (2**129, 0o600, "2^128"),
    ):
        (tmp_path / "seed").write_text(f"{number}\n")
        (tmp_path / "seed").chmod(mode)
        assert expected in told(parts=[sealed], use=[smallest_dataset])
    other = tmp_path / "other"
    shutil.copytree(made.out, other)
    manifest = json.loads((other / "MANIFEST.json").read_text())
    (other / "MANIFEST.json").write_text(json.dumps(manifest | {"benchmark": "2.0"}))
    assert "version 2.0 of the benchmark" in told(out=other)


def test_command_line_speaks_in_sentences(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--out", str(tmp_path / "a"), "--work", str(tmp_path / "b"), "--secret-seed", str(tmp_path / "c")]
    assert main(["release", "--part", "tset", *options]) == 2
    assert "there is no part 'tset'" in capsys.readouterr().err
    assert main(["release", "--part", "films", "--dry-run", *options]) == 0
    assert "phibench-v4-films: 6 films" in capsys.readouterr().out
    assert main(["fetch", "dev", "--out", str(tmp_path / "d")]) == 2
    assert SOURCE in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


# Croissant beside data sets.


def test_croissant_of_a_data_set_is_valid_and_gives_the_rows(smallest_dataset: Path) -> None:
    import mlcroissant
    import polars

    found = mlcroissant.Dataset(jsonld=str(smallest_dataset / "croissant.json"))  # raises what is not valid
    records, table = list(found.records("pairs")), polars.read_parquet(smallest_dataset / "manifest.parquet")
    assert [record["pairs/depth_m"] for record in records] == table["depth_m"].to_list()
    document = json.loads((smallest_dataset / "croissant.json").read_text())
    assert {one["name"] for one in document["recordSet"][0]["field"]} == set(table.columns)
    assert sum(name.startswith("rai:") for name in document) >= 10
    assert "http://mlcommons.org/croissant/1.1" in document["conformsTo"]


def test_croissant_of_films_and_of_a_release_is_valid(film_windows: Path, made: Made) -> None:
    import mlcroissant

    films = mlcroissant.Dataset(jsonld=str(film_windows / "croissant.json"))
    assert [record["frames/frame"] for record in films.records("frames")] == list(range(10))
    whole = mlcroissant.Dataset(jsonld=str(made.out / "croissant.json"))
    assert whole.metadata.version == f"{VERSION}.0"
    assert len(json.loads((made.out / "croissant.json").read_text())["distribution"]) == made.released.made + 1


def test_data_sets_without_one_are_no_faults_and_a_lost_one_is(smallest_dataset: Path, tmp_path: Path) -> None:
    folder = tmp_path / "set"
    shutil.copytree(smallest_dataset, folder)
    (folder / "croissant.json").unlink()
    assert damaged_files(folder) == ["croissant.json is missing"]
    sums = folder / "SHA256SUMS"  # as version 0.2 wrote it
    sums.write_text("".join(x for x in sums.read_text().splitlines(True) if "croissant" not in x))
    assert damaged_files(folder) == []
