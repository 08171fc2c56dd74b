import json
import os
import shutil
from collections.abc import Callable, Generator, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

# Test workers of a machine are as many as its cores, and threads of BLAS beside them only spin.
if "PYTEST_XDIST_WORKER" in os.environ:
    for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(_name, "1")

if TYPE_CHECKING:
    from xdist.scheduler import LoadScopeScheduling

RUN_FIRST = (
    "tests/browser/test_report_in_browser.py",
    "tests/io/",
    "tests/datasets/",
    "tests/contracts/test_classifiers_contract.py",
    "tests/browser/",
    "tests/docs/test_docs.py::test_examples",
    "tests/studies/test_simulated_study.py",
    "tests/demo/",
    "tests/study/",
    "tests/report/",
)
"""Files that start first, as they take longest. The first one compiles the fit; those after it need no fit, so that it
is not compiled twice."""
INDEPENDENT_TESTS = ("tests/docs/test_docs.py",)
"""Files whose tests share no fixtures, so that any worker may run each test."""


def start_order(nodeid: str) -> int:
    """Return the index of a test in `RUN_FIRST`, or the number of entries."""
    return next((place for place, start in enumerate(RUN_FIRST) if nodeid.startswith(start)), len(RUN_FIRST))


def scheduling_unit(nodeid: str) -> str:
    """Return the group of tests that one worker runs: the file, or the test alone."""
    file = nodeid.partition("::")[0]
    return nodeid if file in INDEPENDENT_TESTS else file


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> "LoadScopeScheduling | None":
    """Give all tests of a file to one worker, which makes what they share once.

    The marks of pytest-xdist do not do it with every pytest: 9.2 no longer passes them on.
    """
    if config.getoption("dist") != "load":
        return None
    from xdist.scheduler import LoadScopeScheduling

    class Units(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return scheduling_unit(nodeid)

    config.option.loadscopereorder = False
    return Units(config, log)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    items.sort(key=lambda item: start_order(item.nodeid))


@pytest.hookimpl(wrapper=True)
def pytest_fixture_setup(
    fixturedef: pytest.FixtureDef[object], request: pytest.FixtureRequest
) -> Generator[None, object, object]:
    """Let nothing that a file shares be made by two workers: it would go unnoticed, and cost minutes."""
    worker = os.environ.get("PYTEST_XDIST_WORKER")
    if worker and fixturedef.scope == "module":
        base = request.getfixturevalue("tmp_path_factory").getbasetemp().parent
        makers = base / "makers" / f"{request.node.nodeid}::{fixturedef.argname}".replace("/", "-")
        makers.mkdir(parents=True, exist_ok=True)
        (makers / worker).touch()
        assert [maker.name for maker in makers.iterdir()] == [worker], f"{makers.name} was made by two workers"
    return (yield)


@pytest.fixture(scope="session", autouse=True)
def kept(tmp_path_factory: pytest.TempPathFactory, worker_id: str) -> Iterator[None]:
    """A folder for what is kept between runs, one for all workers of pytest-xdist and none of the user's."""
    folder = tmp_path_factory.getbasetemp()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SHAPESPACE_KEEP", str((folder if worker_id == "master" else folder.parent) / "kept"))
        yield


@pytest.fixture(scope="session")
def made_once(tmp_path_factory: pytest.TempPathFactory, worker_id: str) -> Callable[[Callable[[Path], None]], Path]:
    """Return a function that has a folder filled by the first worker that asks, while the others wait for it."""
    base = tmp_path_factory.getbasetemp()

    def made(fill: Callable[[Path], None]) -> Path:
        if worker_id == "master":
            fill(folder := tmp_path_factory.mktemp(fill.__name__))
            return folder
        import fcntl

        folder = base.parent / "made" / fill.__name__
        folder.parent.mkdir(exist_ok=True)
        with folder.with_suffix(".lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not (done := folder.with_suffix(".done")).exists():
                shutil.rmtree(folder, ignore_errors=True)
                folder.mkdir()
                fill(folder)
                done.touch()
        return folder

    return made


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real data that is not part of the repository."""
    named = os.environ.get("SHAPESPACE_DATA")
    folder = Path(named) if named else Path(__file__).resolve().parents[2] / "shared" / "data"
    if not (folder / "james" / "james.obj").is_file():
        pytest.skip("real data absent: set SHAPESPACE_DATA to a folder holding james/ and ict-facekit/")
    return folder


@pytest.fixture(scope="session")
def geomorph_reference(shared_data: Path) -> dict[str, Any]:
    """Data sets of geomorph with results of geomorph and RRPP, which are not part of the repository."""
    path = shared_data / "geomorph" / "reference.json"
    if not path.is_file():
        pytest.skip("reference results of geomorph absent: set SHAPESPACE_DATA to a folder holding geomorph/")
    return json.loads(path.read_text())


@pytest.fixture(scope="session")
def cluster() -> Iterator[Any]:
    """A client of a Dask scheduler and two workers in processes of their own, for the contracts of executors."""
    distributed = pytest.importorskip("distributed", reason="the extra 'cluster' is not installed")
    with (
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address="127.0.0.1:0") as cluster,
        distributed.Client(cluster) as client,
    ):
        yield client


@pytest.fixture(scope="module")
def few_modes() -> Iterator[None]:
    """Search poses with few smooth modes, which blobs need no more of; this takes most of the time of a test."""
    from shapespace.correspondence import template

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(template, "MODES", 15)
        yield


@pytest.fixture
def write(tmp_path: Path):
    """Write text or bytes to a file of the given name and return its path."""

    def put(name: str, content: str | bytes) -> Path:
        path = tmp_path / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return put
