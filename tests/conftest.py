# Licensed under a 3-clause BSD style license - see LICENSE
"""Fixtures and settings common to all tests."""

import os
import signal
import sys
from pathlib import Path

import pytest
from hypothesis import HealthCheck, is_hypothesis_test, settings

REPOSITORY = Path(__file__).resolve().parents[1]
FEW_EXAMPLES = 5

# no window system is needed to test a figure
os.environ.setdefault("MPLBACKEND", "agg")

# small matrices gain nothing from threads, and those of parallel tests (-n) take the
# cores from each other; processes started from here on, the workers too, obey this
for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")

# the same examples every time, however slow the machine
settings.register_profile(
    "ci",
    derandomize=True,
    deadline=None,
    database=None,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "ci"))


def pytest_configure(config):
    """Name the versions that matter in the header of the report."""
    # a shell starts what runs in the background deaf to interruptions; some tests make some
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        from pytest_astropy_header.display import PYTEST_HEADER_MODULES, TESTED_VERSIONS
    except ImportError:
        return
    config.option.astropy_header = True
    PYTEST_HEADER_MODULES.clear()
    for name in ("numpy", "scipy", "astropy", "asdf", "matplotlib", "photutils", "specutils"):
        PYTEST_HEADER_MODULES[name] = name
    from astropolcal.version import version

    TESTED_VERSIONS["astropolcal"] = version


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config, items):
    """Examples and long tests are slow; without slow tests each law has few examples."""
    for item in items:
        if isinstance(item, pytest.DoctestItem) or item.get_closest_marker("long"):
            item.add_marker(pytest.mark.slow)
    if config.option.markexpr == "not slow":
        for item in items:
            _few_examples(getattr(item, "obj", None))


def _few_examples(test):
    if is_hypothesis_test(test):
        # what @settings sets; there is no public way to lower it from outside
        known = getattr(test, "_hypothesis_internal_use_settings", None) or settings.default
        few = settings(known, max_examples=min(known.max_examples, FEW_EXAMPLES))
        test._hypothesis_internal_use_settings = few


@pytest.fixture(autouse=True)
def warnings_of_a_fresh_process():
    """What is said once in a process is said once in each test."""
    module = sys.modules.get("astropolcal.observations.pointings")
    if module is not None:
        module._SAID.clear()


@pytest.fixture
def no_network(monkeypatch):
    """Fail where a table would be fetched, as astropy does by itself from old ones."""
    from astropy.time import core
    from astropy.utils import iers

    def refuse(*arguments, **options):
        raise AssertionError("the network was asked")

    def check():
        assert not iers.conf.auto_download, "new leap seconds may be fetched"

    monkeypatch.setattr(iers.iers, "download_file", refuse)
    # astropy looks for leap seconds once in a process, this check in every conversion
    monkeypatch.setattr(core, "_check_leapsec", check, raising=False)
    # in days, the least that is allowed: what comes with astropy is older than that in most places
    with iers.conf.set_temp("auto_max_age", 10), iers.conf.set_temp("auto_download", True):
        yield
        assert iers.conf.auto_download
        assert iers.conf.auto_max_age == 10


@pytest.fixture(scope="session")
def repository():
    """Root folder of the source tree."""
    return REPOSITORY


@pytest.fixture(scope="session")
def shared_data():
    """Folder of reference measurements beside the repository, or skip."""
    folder = REPOSITORY.parent / "shared"
    if not folder.is_dir():
        pytest.skip(f"reference data are absent: no folder {folder.name!r} beside the repository")
    return folder


@pytest.fixture
def unpainted(monkeypatch):
    """Figures are made, but not painted, which takes most of the time."""
    from matplotlib.figure import Figure

    monkeypatch.setattr(Figure, "savefig", lambda self, path, **_: path.write_bytes(b"painted"))


@pytest.fixture
def other_svd(monkeypatch):
    """Function after which singular vectors are others that are as good."""
    # not above: the number of threads has to be set before
    import numpy as np

    real = np.linalg.svd

    def svd(matrix, full_matrices=True, compute_uv=True, **options):
        found = real(matrix, full_matrices, compute_uv, **options)
        if not compute_uv:
            return found
        left, singular, right = -found[0], found[1], -found[2]
        if np.ndim(matrix) == 2 and np.sum(singular > 1e-12 * singular.max()) < len(right) - 1:
            # of two directions in which nothing changes a mixture is one too
            right[-2:] = [right[-2] + right[-1], right[-2] - right[-1]] / np.sqrt(2)
        return left, singular, right

    return lambda: monkeypatch.setattr(np.linalg, "svd", svd)


@pytest.fixture(scope="session")
def random_chain():
    """
    Function that makes a chain of random optics from all that are registered.

    ``random_chain(rng, n_wavelengths, n_optics=6, split=False)``: values anywhere
    within the bounds, half of them one a wavelength, on stages "a", "b" and "c"
    or on none; with ``split`` a Wollaston prism stands among the optics.
    """
    return _random_chain


def _random_chain(rng, n_wavelengths, n_optics=6, split=False):
    from astropolcal.chain import join
    from astropolcal.optics import OPTICS

    names = sorted(set(OPTICS) - {"WollastonPrism"})
    kinds = list(rng.choice(names, n_optics))
    if split:
        kinds.insert(rng.integers(n_optics + 1), "WollastonPrism")
    mounts = rng.choice(["a", "b", "-b", "-c", ""], len(kinds))
    chain = []
    for i, (kind, mount) in enumerate(zip(kinds, mounts, strict=True)):
        values = _random_values(OPTICS[kind], rng, n_wavelengths)
        chain.append(OPTICS[kind](name=f"{kind}_{i}", mount=str(mount) or None, **values))
    return join(chain)


def _random_values(optic, rng, n_wavelengths):
    values = {}
    for key, parameter in ((k, getattr(optic(), k)) for k in optic().param_names):
        low, high = (0.5 if bound is None else 0.9 * bound for bound in parameter.bounds)
        size = n_wavelengths if n_wavelengths and rng.random() < 0.5 else None
        values[key] = rng.uniform(low, high, size) * (parameter.unit or 1)
    return values
