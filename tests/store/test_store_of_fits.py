"""Stores of fits: what goes in comes out, whatever is killed, damaged or made to harm."""

import hashlib
import json
import os
import shutil
import sys
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from shapespace import cli
from shapespace.batch.fit_records import read_record
from shapespace.batch.result_folder import CoefficientTable
from shapespace.batch.store import Store
from shapespace.commands.export import export
from shapespace.errors import FileFormatError, InputError, ShapespaceError
from shapespace.io.meshes.mesh_io import read_mesh
from shapespace.io.meshes.ply import ply_comment, write_ply
from shapespace.schemas import FitRecord
from shapespace.store import manifest as manifests
from shapespace.store.manifest import read_manifest
from shapespace.store.results import Results, mesh_at
from stored_fits import MODES, VERTICES, content, model, write_fit, write_fits

pytest.importorskip("pyarrow", reason="the extra `store` is not installed")
pytest.importorskip("zarr", reason="the extra `store` is not installed")

PRECISION = 6e-8
"""Of the half extent of a surface; stated in docs."""


def edit(folder: Path, change: Any) -> None:
    """Change the manifest of a store as JSON."""
    path = folder / "manifest.json"
    told = json.loads(path.read_text())
    change(told)
    path.write_text(json.dumps(told))


def checked(folder: Path, part: str, shard: int = 0) -> None:
    """Make the manifest believe what a file of a shard holds now, as whoever wants to harm would."""
    entry = manifests.read(manifests.Manifest, json.loads((folder / "manifest.json").read_text()), "", "").shards[shard]
    data = (folder / getattr(entry, part).file).read_bytes()
    told: dict[str, Any] = {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    if part == "table":
        end = 8 + int.from_bytes(data[-8:-4], "little")
        told |= {"end_bytes": end, "end_sha256": hashlib.sha256(data[-end:]).hexdigest()}
    edit(folder, lambda found: found["shards"][shard][part].update(told))


@pytest.fixture(scope="module")
def singles(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("singles") / "out"
    write_fits(folder)
    return folder


@pytest.fixture(scope="module")
def template(singles: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("store") / "out"
    shutil.copytree(singles, folder)
    assert Store(folder).compact(rows=5).left == {}
    return folder


@pytest.fixture
def store(template: Path, tmp_path: Path) -> Path:
    shutil.copytree(template, tmp_path / "out")
    return tmp_path / "out"


def assert_same(results: Results, singles: Path) -> None:
    """Check that results hold what the single files of a folder do."""
    kept = Results(singles)
    assert results.names() == kept.names()
    assert results.problems == []
    for name in kept.names():
        assert results.record_bytes(name) == (singles / f"{name}.fit.json").read_bytes()
        for kind in ("fitted", "dense"):
            assert results.has(name, kind) == kept.has(name, kind)
            if kept.has(name, kind):
                one, other = results.surface(name, kind), kept.surface(name, kind)
                extent = np.ptp(other.vertices, axis=0).max() / 2
                assert np.abs(one.vertices - other.vertices).max() <= PRECISION * extent
                assert np.array_equal(one.faces, other.faces) and one.name == other.name
        if kept.has(name, "stages"):
            assert results.stages(name) == (singles / f"{name}.stages.npz").read_bytes()


def test_what_goes_in_comes_out(singles: Path, template: Path) -> None:
    results = Results(template)
    assert_same(results, singles)
    assert not list(template.glob("*.fit.json")) and not list(template.glob("*.ply")) + list(template.glob("*.npz"))
    assert results.counts() == Results(singles).counts()
    assert results.identities() == Store(template).identities() == Results(singles).identities()


def test_export_gives_the_single_files_back(store: Path, singles: Path, tmp_path: Path) -> None:
    assert cli.main(["export", str(store), "--all", "-o", str(tmp_path / "back"), "--quiet"]) == 0
    assert_same(Results(tmp_path / "back"), singles)
    assert sorted(content(tmp_path / "back")) == sorted(content(singles))


def test_colours_of_surfaces_stay_with_theirs(singles: Path, tmp_path: Path) -> None:
    folder = tmp_path / "painted"
    shutil.copytree(singles, folder)
    path = sorted(folder.glob("*.fitted.ply"))[1]
    mesh = read_mesh(path)
    colours = np.arange(mesh.vertices.size, dtype=np.uint8).reshape(-1, 3)
    path.write_bytes(write_ply(replace(mesh, colours=colours), ply_comment(path)))
    assert not Store(folder).compact().left
    results = Results(folder)
    for name in (one for one in results.names() if results.has(one, "fitted")):
        found = results.surface(name).colours
        assert np.array_equal(found, colours) if path.name.startswith(name) else found is None


def test_export_of_a_name_that_there_is_not_names_near_ones(store: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["export", str(store), "scan00", "-o", str(store.parent / "x")]) == 2
    told = capsys.readouterr().err
    assert "contains no fit called scan00; there is scan0" in told
    assert not (store.parent / "x").exists()


def test_the_exported_table_is_the_table_of_a_folder(store: Path, singles: Path, tmp_path: Path) -> None:
    names = sorted(Results(singles).names())
    table = CoefficientTable(singles, names, MODES)
    table.catch_up(names)
    table.save()
    expected = (singles / "coefficients.csv").read_bytes()
    (singles / "coefficients.csv").unlink()
    for folder in (store, singles):
        export(folder, [], tmp_path, every=False, table=tmp_path / "t.csv", quiet=True, say=pytest.fail)
        assert (tmp_path / "t.csv").read_bytes() == expected


def test_pandas_reads_the_tables_as_they_stand(store: Path, singles: Path) -> None:
    pandas = pytest.importorskip("pandas")
    frame = pandas.read_parquet(store / "table").set_index("scan").sort_index()
    record = read_record(singles / "scan002.fit.json")
    assert list(frame.index) == Results(singles).names()
    assert frame.loc["scan002", "z3"] == record.z[2]
    assert frame.loc["scan002", "expected_error_mm"] == record.evidence["expected_error_mm"]
    text = frame.loc["scan002", "record"]
    assert text == (singles / "scan002.fit.json").read_text()
    assert FitRecord.from_json(json.loads(text), "scan002") == record
    assert frame["status"].value_counts().to_dict() == dict(Results(singles).counts())


def test_all_tables_have_the_columns_of_a_fit(tmp_path: Path) -> None:
    import pyarrow.parquet as pq

    for k, status in enumerate(("converged", "failed")):
        write_fit(tmp_path, f"fit{k}", k, status=status, metadata={"site": "Oslo"} if k == 0 else {})
        Store(tmp_path).compact()
    first, second = (pq.read_schema(path).names for path in sorted((tmp_path / "table").iterdir()))
    assert first == second and {"z4", "b4_stddev", "evidence_z2", "meta_site"} <= set(first)
    write_fit(tmp_path, "fit0", 7, status="failed")
    Store(tmp_path).compact()
    assert all(pq.read_schema(path).names == first for path in (tmp_path / "table").iterdir())


def test_columns_of_the_list_of_scans_are_columns_of_the_table(tmp_path: Path) -> None:
    write_fit(tmp_path, "a", 1, metadata={"site": "Oslo", "age": 41})
    write_fit(tmp_path, "b", 2, metadata={"site": "=cmd", "day": None})
    Store(tmp_path).compact()
    found = {column: [] for column in ("scan", "meta_site", "meta_age", "meta_day")}
    for rows in Results(tmp_path).iter_rows(list(found)):
        for column, values in rows.items():
            found[column] += values
    assert found == {
        "scan": ["a", "b"],
        "meta_site": ["Oslo", "=cmd"],
        "meta_age": ["41", None],
        "meta_day": [None, ""],
    }


def test_other_programs_read_the_surfaces_as_zarr(store: Path) -> None:
    import zarr

    entry = read_manifest(store).shards[0]  # type: ignore[union-attr]
    with zarr.storage.ZipStore(store / entry.surfaces.file, mode="r") as kept:  # type: ignore[union-attr]
        group = zarr.open_group(kept, mode="r")
        at = group["fitted"][1] + group["fitted_origin"][1]
    assert at.shape == (VERTICES, 3)
    assert np.abs(at - Results(store).surface("scan001").vertices).max() == 0


def test_surfaces_of_other_models_go_to_shards_of_their_own(tmp_path: Path) -> None:
    write_fits(tmp_path, 3)
    mesh = model().mesh()
    other = type(mesh)(mesh.vertices[:-1], mesh.faces[(mesh.faces < VERTICES - 1).all(axis=1)])  # type: ignore[index]
    for kind in ("fitted", "dense"):
        cli_path = tmp_path / f"scan000.{kind}.ply"
        from shapespace.io.meshes.mesh_io import write_mesh

        write_mesh(cli_path, other)
    assert len(Store(tmp_path).compact().moved) == 3
    results = Results(tmp_path)
    assert len(results.surface("scan000").vertices) == VERTICES - 1
    assert len(results.surface("scan001").vertices) == VERTICES


def test_what_cannot_be_moved_stays_and_is_told_of(tmp_path: Path) -> None:
    names = write_fits(tmp_path, 4)
    (tmp_path / "scan000.fitted.ply").unlink()
    (tmp_path / "scan001.fit.json").write_text("{")
    (tmp_path / "scan002.fitted.ply").write_bytes(b"ply\n")
    before = content(tmp_path)
    done = Store(tmp_path).compact()
    assert done.moved == names[3:] and set(done.left) == set(names[:3])
    assert all(told.endswith(".") and "\n" not in told for told in done.left.values())
    assert {path: before[path] for path in before if "scan003" not in path}.items() <= content(tmp_path).items()


def test_a_newer_single_result_replaces_the_stored_one(store: Path) -> None:
    write_fit(store, "scan001", 77)
    results = Results(store)
    assert results.record("scan001")["id"] == f"{78:064x}" and len(results) == 12
    assert results.identities()["scan001"] == f"{78:064x}"
    Store(store).compact()
    results = Results(store)
    assert results.record("scan001")["id"] == f"{78:064x}" and len(results) == 12 and not results.singles
    pandas = pytest.importorskip("pandas")
    assert pandas.read_parquet(store / "table")["scan"].is_unique
    assert results.surface("scan003").vertices.shape == (VERTICES, 3)


KILLED = """
import os, sys
from pathlib import Path
from shapespace.batch import store
left = [int(sys.argv[2])]
def dying(do):
    def step(*args, **kwargs):
        left[0] -= 1
        if left[0] < 0:
            os._exit(9)
        return do(*args, **kwargs)
    return step
store.remove_file = dying(store.remove_file)
store._to_disk = dying(store._to_disk)
store.sha256_of_file = dying(store.sha256_of_file)
store.Store(Path(sys.argv[1])).compact(rows=1)
"""


def test_killed_at_any_step_nothing_is_lost_or_counted_twice(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Disks are slow, and a killed process takes nothing with it that it wrote.
    monkeypatch.setattr(os, "fsync", lambda _: None)
    names = write_fits(tmp_path / "before", 2)
    steps = 0
    seen: set[tuple[int, int]] = set()
    # A process for each step would take minutes; a fork of one does not.
    while True:
        folder = tmp_path / f"killed{steps}"
        shutil.copytree(tmp_path / "before", folder)
        child = os.fork() if hasattr(os, "fork") else pytest.skip("no fork here")
        if child == 0:
            sys.argv = ["", str(folder), str(steps)]
            try:
                exec(compile(KILLED, "killed", "exec"), {"__name__": "x"})
            finally:
                os._exit(0)
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        assert_same(Results(folder), tmp_path / "before")
        assert sum(Results(folder).counts().values()) == len(names)
        seen.add((len(Results(folder).singles), code))
        if steps % 5 == 0 or code == 0:
            Store(folder).compact(rows=1)
            assert_same(Results(folder), tmp_path / "before")
            named = {file.file for shard in read_manifest(folder).shards for file in shard.files}  # type: ignore[union-attr]
            assert set(content(folder)) == {"manifest.json", *named}
        if code == 0:
            break
        shutil.rmtree(folder)
        steps += 1
    assert steps > 20 and {count for count, _ in seen} == {0, 1, 2}


def test_a_damaged_shard_is_named_and_the_others_are_read(store: Path) -> None:
    path = store / read_manifest(store).shards[0].table.file  # type: ignore[union-attr]
    path.write_bytes(path.read_bytes()[:-1])
    results = Results(store)
    assert len(results) == 7 and "scan000" not in results and "scan005" in results
    assert results.counts().total() == 7
    (problem,) = results.problems
    assert path.name in problem and problem.endswith(".")
    with pytest.raises(InputError, match="some shards cannot be read"):
        results.record("scan000")


def test_a_shard_that_comes_back_after_its_scans_were_fitted_again_counts_nothing_twice(store: Path) -> None:
    path = store / read_manifest(store).shards[0].table.file  # type: ignore[union-attr]
    whole = path.read_bytes()
    path.write_bytes(whole[:100])
    write_fit(store, "scan000", 77)
    assert Store(store).compact().moved == ["scan000"]
    path.write_bytes(whole)
    results = Results(store)
    assert len(results) == 12 == results.counts().total()
    assert results.record("scan000")["id"] == f"{78:064x}"


def test_a_flipped_bit_is_found_or_changes_nothing(template: Path, singles: Path, tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    entry = read_manifest(template).shards[0]  # type: ignore[union-attr]
    for part in ("table", "surfaces"):
        file = getattr(entry, part).file
        data = (template / file).read_bytes()
        for k, at in enumerate(rng.choice(len(data), 10, replace=False)):
            folder = tmp_path / f"{part}{k}"
            shutil.copytree(template, folder)
            (folder / file).write_bytes(data[:at] + bytes([data[at] ^ (1 << int(rng.integers(8)))]) + data[at + 1 :])
            results = Results(folder)
            try:
                for name in ("scan000", "scan001", "scan002"):
                    assert results.record_bytes(name) == (singles / f"{name}.fit.json").read_bytes()
                    found = results.surface(name).vertices
                    assert np.array_equal(found, Results(template).surface(name).vertices)
            except ShapespaceError as error:
                assert "\n" not in str(error)
            shutil.rmtree(folder)


def test_info_compares_every_file_with_its_hash(store: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = store / read_manifest(store).shards[1].surfaces.file  # type: ignore[union-attr]
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    assert cli.main(["info", str(store), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["fits"], told["failed"], told["modes"], told["shards"]) == (12, 2, MODES, 3)
    assert len(told["damaged"]) == 1 and path.name in told["damaged"][0]


@pytest.mark.parametrize("name", ["../../secret.parquet", "/etc/passwd", "table/../../x.parquet", "table/a\0.parquet"])
def test_a_manifest_leads_nowhere_else(store: Path, name: str) -> None:
    edit(store, lambda told: told["shards"][0]["table"].update(file=name))
    results = Results(store)
    assert len(results) == 7
    assert "no file of a store" in results.problems[0]


def test_a_link_in_place_of_a_shard_is_refused(store: Path, tmp_path: Path) -> None:
    path = store / read_manifest(store).shards[0].surfaces.file  # type: ignore[union-attr]
    shutil.move(path, tmp_path / "elsewhere")
    path.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(FileFormatError, match="no file of a store"):
        Results(store).surface("scan000")


@pytest.mark.parametrize("text", ["", "{", "[]", "null", '{"format": "shapespace store"}', "[" * 100_000])
def test_a_damaged_manifest_is_one_sentence(store: Path, text: str) -> None:
    (store / "manifest.json").write_text(text)
    with pytest.raises(FileFormatError, match=r"manifest\.json"):
        Results(store)


def test_shards_without_their_manifest_are_neither_ignored_nor_removed(store: Path) -> None:
    (store / "manifest.json").unlink()
    write_fit(store, "new", 5)
    before = content(store)
    for act in (lambda: Results(store), lambda: Store(store).compact()):
        with pytest.raises(FileFormatError, match=r"without their manifest\.json"):
            act()
    assert content(store) == before


def test_fits_of_a_shard_that_an_older_manifest_does_not_name_are_not_removed(store: Path) -> None:
    edit(store, lambda told: told["shards"].pop())
    before = content(store)
    with pytest.raises(FileFormatError, match="are in no other file"):
        Store(store).compact()
    assert content(store) == before


def test_a_manifest_of_something_else_is_no_store(singles: Path, tmp_path: Path) -> None:
    shutil.copytree(singles, tmp_path / "out")
    (tmp_path / "out" / "manifest.json").write_text('{"files": []}')
    assert_same(Results(tmp_path / "out"), singles)


def test_names_that_lead_elsewhere_are_refused(store: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    path = store / read_manifest(store).shards[0].table.file  # type: ignore[union-attr]
    table = pq.read_table(path)
    scans = pa.array(["../../evil", *table.column("scan").to_pylist()[1:]])
    pq.write_table(table.set_column(table.column_names.index("scan"), "scan", scans), path, write_page_checksum=True)
    checked(store, "table")
    results = Results(store)
    assert len(results) == 7 and "names that no results can have" in results.problems[0]


def test_a_table_that_would_grow_without_end_is_refused_before_it_is_read(store: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    path = store / read_manifest(store).shards[0].table.file  # type: ignore[union-attr]
    table = pq.read_table(path)
    bomb = pa.array(["a" * 2**24] * table.num_rows)
    table = table.set_column(table.column_names.index("record"), "record", bomb)
    pq.write_table(table, path, compression="zstd", use_dictionary=False, write_page_checksum=True)
    assert path.stat().st_size < 2**20
    checked(store, "table")
    results = Results(store)
    assert len(results) == 7 and "is not a table of a store" in results.problems[0]


@pytest.mark.parametrize("harm", ["compressed", "huge", "codec", "object", "absent", "short"])
def test_surfaces_made_to_harm_are_refused(store: Path, harm: str) -> None:
    path = store / read_manifest(store).shards[0].surfaces.file  # type: ignore[union-attr]
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    told = json.loads(members["fitted/zarr.json"])
    kind = zipfile.ZIP_STORED
    if harm == "compressed":
        members["more/zarr.json"], kind = json.dumps(told).encode() + b" " * 2**24, zipfile.ZIP_DEFLATED
    elif harm == "huge":
        told["shape"][1] = told["chunk_grid"]["configuration"]["chunk_shape"][1] = 2**30
    elif harm == "codec":
        told["codecs"].append({"name": "gzip", "configuration": {"level": 5}})
    elif harm == "object":
        told["data_type"] = "variable_length_bytes"
    elif harm == "absent":
        del members["fitted/c/0/0/0"]
    else:
        members["fitted/c/0/0/0"] = members["fitted/c/0/0/0"][:-4]
    members["fitted/zarr.json"] = json.dumps(told).encode()
    with zipfile.ZipFile(path, "w", kind) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    checked(store, "surfaces")
    with pytest.raises(FileFormatError, match=path.name) as told_of:
        Results(store).surface("scan000")
    # What is compressed is refused before any of it is unpacked.
    assert ("is not a file of a store" in str(told_of.value)) == (harm == "compressed")


def test_without_the_extra_one_sentence_says_what_to_install(store: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(manifests, "find_spec", lambda name: None if name == "zarr" else object())
    with pytest.raises(ShapespaceError, match=r"needs zarr; run pip install 'shapespace\[store\]'"):
        Results(store)


def test_a_folder_without_a_store_needs_no_extra(singles: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(manifests, "find_spec", lambda _: None)
    assert len(Results(singles)) == 12


# The commands


def test_build_and_quality_take_the_surfaces_of_a_store(store: Path, tmp_path: Path) -> None:
    taken = [path.name for path in (store / "scan000.dense.ply", store / "scan002.dense.ply")]
    assert all(len(mesh_at(store / name).vertices) == VERTICES for name in taken)
    model().save(tmp_path / "model.h5")
    output = tmp_path / "new.h5"
    assert cli.main(["build", str(store), "-o", str(output), "--modes", "all", "--with-doubtful", "--quiet"]) == 0
    from shapespace.model.shape_model import ShapeModel

    built = ShapeModel.load(output)
    assert built.n_training == 6 and built.n_vertices == VERTICES
    assert built.landmarks == model().landmarks


def test_build_takes_the_fitted_surfaces_as_it_takes_their_files(store: Path, singles: Path, tmp_path: Path) -> None:
    for name, folder in (("a", singles), ("b", store)):
        files = [str(folder / f"scan00{k}.fitted.ply") for k in (0, 1, 2, 3)]
        command = ["build", *files, "-o", str(tmp_path / f"{name}.h5"), "--modes", "all", "--gauge", "form", "--quiet"]
        assert cli.main(command) == 0
    from shapespace.model.shape_model import ShapeModel

    one, other = (ShapeModel.load(tmp_path / f"{name}.h5") for name in "ab")
    assert np.allclose(one.mean_vertices, other.mean_vertices, atol=1e-4)
    assert np.allclose(one.stddev, other.stddev, rtol=1e-5)


def test_build_leaves_out_doubtful_fits_of_a_store(
    store: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["build", str(store), "-o", str(tmp_path / "m.h5"), "--modes", "all"]) == 0
    assert "doubtful fits are excluded (scan004.dense.ply" in capsys.readouterr().err.replace("2 surfaces of ", "")


def test_recognition_reads_a_store_as_it_reads_its_files(store: Path, singles: Path) -> None:
    from shapespace.commands.recognise import read_scans

    for one, other in zip(read_scans(store), read_scans(singles), strict=True):
        assert (one.name, one.status, one.reason, one.model_hash, one.file) == (
            other.name, other.status, other.reason, other.model_hash, other.file,
        )  # fmt: skip
        assert (one.z is None) == (other.z is None)
        assert one.z is None or np.array_equal(one.z, other.z)


def test_recognition_says_which_shard_it_did_not_read(store: Path) -> None:
    from shapespace.commands.recognise import read_scans

    path = store / read_manifest(store).shards[0].table.file  # type: ignore[union-attr]
    path.unlink()
    told: list[str] = []
    assert len(read_scans(store, told.append)) == 7
    assert len(told) == 1 and path.name in told[0]


def test_the_record_of_a_stored_fit_is_read_as_if_it_were_a_file(store: Path, singles: Path) -> None:
    assert read_record(store / "scan003.fit.json") == read_record(singles / "scan003.fit.json")
