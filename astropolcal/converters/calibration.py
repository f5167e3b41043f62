# Licensed under a 3-clause BSD style license - see LICENSE
"""
The converter of calibrations.

The node holds everything of a `~astropolcal.calibration.Calibration` but the
measurement, so the observations themselves stay outside. Its checksum covers
all numbers and words, so that a file either gives back what was written or is
refused.

A file of an older version of the schema is checked against that version and its
checksum, and then carried to the newest one step by step, see ``MIGRATIONS``.
"""

from asdf.extension import Converter

from astropolcal.exceptions import CalibrationFileError

__all__ = [
    "CALIBRATION_TAG",
    "CALIBRATION_TAGS",
    "MIGRATIONS",
    "CalibrationConverter",
    "calibration_from_node",
    "node_from_calibration",
]

#: Versions of the schema that can be read, oldest first; the newest is written.
CALIBRATION_TAGS = tuple(
    f"tag:astropolcal.org:astropolcal/calibration-{version}" for version in ("1.0.0", "1.1.0")
)
CALIBRATION_TAG = CALIBRATION_TAGS[-1]

# what is written for those who look into the file, and worked out again on reading
_DERIVED = ("checksum", "validity", "written_with")


class CalibrationConverter(Converter):
    """
    Convert a calibration.

    Examples
    --------
    >>> from astropolcal.converters.calibration import CalibrationConverter
    >>> CalibrationConverter().types
    ['astropolcal.calibration.result.Calibration']
    """

    @property
    def tags(self):
        """Tags of a calibration, of all versions."""
        return list(CALIBRATION_TAGS)

    @property
    def types(self):
        """Full name of the class, which is imported only when it is needed."""
        return ["astropolcal.calibration.result.Calibration"]

    def select_tag(self, obj, tags, ctx):
        """Return the tag of the newest version, whatever was read before."""
        return CALIBRATION_TAG

    def to_yaml_tree(self, obj, tag, ctx):
        """Return the node of a calibration, see `node_from_calibration`."""
        return node_from_calibration(obj)

    def from_yaml_tree(self, node, tag, ctx):
        """Return the calibration of a node, see `calibration_from_node`."""
        return calibration_from_node(node, tag)


# ---- writing ---------------------------------------------------------------------


def node_from_calibration(calibration):
    """
    Return the node that stores a calibration.

    Parameters
    ----------
    calibration : Calibration
        The calibration.

    Returns
    -------
    dict
        As the schema ``calibration-1.1.0`` describes it.

    Raises
    ------
    CalibrationFileError
        If it is inconsistent, or holds what files cannot hold.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import calibrate, instruments
    >>> from astropolcal.converters.calibration import node_from_calibration
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear")
    >>> frames = half_wave_plate_cycles(derotator=[50, 65, 80] * u.deg)
    >>> cal = calibrate(chain, simulate(chain, charis.wavelength, frames, seed=2))
    >>> node_from_calibration(cal)["covariance"]["names"][:2]
    ['calibration_polarizer.theta', 'hwp.theta']
    """
    from astropolcal.converters.consistency import check_calibration
    from astropolcal.converters.nodes import node_from_value, plain

    check_calibration(calibration)
    node = {
        **_chains_and_priors(calibration.chains),
        "wavelength": node_from_value(calibration.wavelength),
        "covariance": _covariance_node(calibration.covariance),
        "identifiability": _identifiability_node(calibration.identifiability),
        "at_bound": plain(calibration.at_bound, "at_bound"),
        "datasets": [_dataset_node(record) for record in calibration.datasets],
        "settings": plain(calibration.settings, "settings"),
        "fit": plain(calibration.fit, "fit"),
        "ties": [_tie_node(name, tie) for name, tie in calibration.ties.items()],
        "stages": [_stage_node(stage) for stage in calibration.stages],
        "provenance": plain(calibration.provenance, "provenance"),
        **_posterior(calibration),
    }
    return node | {
        "checksum": _checksum(node),
        "validity": _validity(calibration),
        "written_with": _versions(),
    }


def _chains_and_priors(chains):
    """Return the chains, and beside them the priors, which an optic's node cannot hold."""
    from astropolcal.converters.priors import node_from_priors, without_priors

    priors = node_from_priors(chains)
    # copies: to write a calibration must not change it
    chains = [without_priors(chain) for chain in chains] if priors else chains
    node = {"chains": [_chain_node(chain) for chain in chains]}
    return node | {"priors": priors} if priors else node


def _posterior(calibration):
    from astropolcal.converters.posterior import check_posterior, node_from_posterior

    if calibration.posterior is None:
        return {}
    check_posterior(calibration.posterior, calibration.covariance)
    return {"posterior": node_from_posterior(calibration.posterior)}


def _checksum(node):
    from astropolcal.converters.nodes import checksum
    from astropolcal.converters.optics import node_from_optic

    content = {key: value for key, value in node.items() if key not in _DERIVED}
    return checksum(content, expand=node_from_optic)


def _versions():
    from importlib.metadata import version as installed

    from astropolcal.version import version

    names = ("asdf", "asdf-astropy", "astropy")
    return {"astropolcal": version} | {name: installed(name) for name in names}


def _validity(calibration):
    """Return what tells whether a frame may be reduced with the calibration."""
    from astropolcal.calibration.validity import validity_of
    from astropolcal.chain import leaves
    from astropolcal.observations.reading import stated_date

    dates = {stated_date(r.meta, r.name, CalibrationFileError) for r in calibration.datasets}
    return {
        **validity_of(calibration).to_dict(),
        "dates": sorted(dates - {None}),
        "optics_in_beam": [[leaf.name for leaf in leaves(chain)] for chain in calibration.chains],
    }


def _chain_node(chain):
    from astropolcal.chain import leaves

    node = {"optics": leaves(chain)}
    # a chain of one optic is that optic, which has its own name
    # astropy counts one submodel in a model that is no compound
    named = chain.n_submodels > 1 and chain.name
    return node | {"name": chain.name} if named else node


def _covariance_node(covariance):
    from astropolcal.converters.nodes import unit_text

    node = {
        "names": list(covariance.names),
        "units": [unit_text(unit) for unit in covariance.units],
        "matrix": covariance.matrix.copy(),
    }
    if covariance.factor is not None and covariance.factor.size:
        node["factor"] = covariance.factor.copy()
    if covariance.null is not None:
        # row by row: some versions of asdf cannot read an empty matrix
        node["open"] = [row.copy() for row in covariance.null]
    return node


def _identifiability_node(finding):
    from astropolcal.converters.nodes import plain

    node = {
        "names": list(finding.names),
        "rank": int(finding.rank),
        "singular_values": finding.singular_values.copy(),
        # row by row: some versions of asdf cannot read an empty matrix
        "null_vectors": [row.copy() for row in finding.null_vectors],
        "identifiable": finding.identifiable.copy(),
        "directions": [_direction_node(direction) for direction in finding.directions],
        "near_null": [_direction_node(direction) for direction in finding.near_null],
        "sampling": list(finding.sampling),
        "mirrors": list(finding.mirrors),
    }
    # absent where there are none, as in files of before
    return node | ({"branches": plain(finding.branches, "branches")} if finding.branches else {})


def _direction_node(direction):
    from astropolcal.converters.nodes import plain

    return {
        "words": str(direction["words"]),
        **({"sky": plain(direction["sky"], "sky")} if "sky" in direction else {}),
        # a list, as a mapping would lose the order
        "parameters": [
            {"name": name, "value": plain(value, name)}
            for name, value in direction["parameters"].items()
        ],
    }


def _dataset_node(record):
    from astropolcal.converters.nodes import node_from_table, plain

    return {
        "name": record.name,
        "source": record.source,
        "content_hash": record.content_hash,
        "meta": plain(record.meta, f"meta of {record.name}"),
        "n_frames": int(record.n_frames),
        "n_masked": int(record.n_masked),
        "accuracy": node_from_table(record.accuracy),
    }


def _tie_node(name, tie):
    from astropolcal.converters.nodes import node_from_value

    return {
        "target": name,
        "source": tie.source,
        "factor": float(tie.factor),
        "offset": node_from_value(tie.offset),
    }


def _stage_node(stage):
    from astropolcal.converters.nodes import node_from_value, plain

    values = stage["parameters"].items()
    return {
        "title": stage["title"],
        "parameters": [{"name": name} | node_from_value(value) for name, value in values],
        "residual_rms": plain(stage["residual_rms"], "residual_rms"),
    }


# ---- reading ---------------------------------------------------------------------


def calibration_from_node(node, tag=CALIBRATION_TAG):
    """
    Return the calibration that a node stores.

    Parameters
    ----------
    node : dict
        Its node, which obeys the schema, with its optics restored.
    tag : str
        Version of the schema that it obeys, one of ``CALIBRATION_TAGS``.

    Returns
    -------
    Calibration
        Without ``measurement``.

    Raises
    ------
    CalibrationFileError
        If the content does not match its checksum or is inconsistent.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import calibrate, instruments
    >>> from astropolcal.converters.calibration import calibration_from_node, node_from_calibration
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear")
    >>> frames = half_wave_plate_cycles(derotator=[50, 65, 80] * u.deg)
    >>> cal = calibrate(chain, simulate(chain, charis.wavelength, frames, seed=2))
    >>> again = calibration_from_node(node_from_calibration(cal))
    >>> again.to_dict() == cal.to_dict()
    True
    """
    from astropolcal.calibration import Calibration
    from astropolcal.calibration.validity import validity_of
    from astropolcal.converters.consistency import check_calibration
    from astropolcal.converters.nodes import plain, value_from_node
    from astropolcal.converters.posterior import check_posterior, posterior_from_node
    from astropolcal.converters.priors import restore_priors

    if _checksum(node) != node["checksum"]:
        raise CalibrationFileError(
            "the content does not match its checksum: it was changed after it was written"
        )
    # after the checksum, which is of the content as it was written
    for step in CALIBRATION_TAGS[CALIBRATION_TAGS.index(tag) : -1]:
        node = MIGRATIONS[step](node)
    chains = [_chain(entry) for entry in node["chains"]]
    # before the calibration is made: its free parameters bind the priors
    restore_priors(chains, node.get("priors", []))
    calibration = Calibration(
        chains=chains,
        wavelength=value_from_node(node["wavelength"]),
        covariance=_covariance(node["covariance"]),
        identifiability=_identifiability(node["identifiability"]),
        at_bound=list(node["at_bound"]),
        datasets=[_dataset(entry) for entry in node["datasets"]],
        settings=plain(node["settings"]),
        fit=plain(node["fit"]),
        ties={name: _tie(entry) for name, entry in _by_name(node["ties"], "target").items()},
        stages=[_stage(entry) for entry in node["stages"]],
        provenance=plain(node["provenance"]),
        posterior=posterior_from_node(node["posterior"]) if "posterior" in node else None,
    )
    check_calibration(calibration)
    check_posterior(calibration.posterior, calibration.covariance)
    validity_of(calibration)
    return calibration


def _to_1_1(node):
    """Version 1.0.0 knew no statement of validity: an entry of that name meant nothing."""
    settings = {key: value for key, value in node["settings"].items() if key != "validity"}
    return {**node, "settings": settings}


#: Tag of an older version to the function that carries a node of it to the next one.
MIGRATIONS = {CALIBRATION_TAGS[0]: _to_1_1}


def _chain(node):
    from astropolcal.chain import join

    chain = join(node["optics"])
    if "name" in node:
        chain.name = node["name"]
    return chain


def _covariance(node):
    import numpy as np

    from astropolcal.calibration import Covariance
    from astropolcal.converters.nodes import unit_from_text

    units = [unit_from_text(text) for text in node["units"]]
    shape = np.shape(node.get("factor", [[0.0] * len(units)]))
    if len(shape) != 2 or shape[1] != len(units):
        # it would be laid out anew, and mean something else
        raise CalibrationFileError(
            f"factor of the covariance has shape {shape}; (rank, {len(units)}) is needed"
        )
    return Covariance(
        node["names"],
        units,
        node["matrix"],
        factor=node.get("factor"),
        null=np.array(node["open"]) if "open" in node else None,
    )


def _identifiability(node):
    import numpy as np

    from astropolcal.calibration import Identifiability
    from astropolcal.converters.nodes import plain

    names, vectors = list(node["names"]), node["null_vectors"]
    return Identifiability(
        names=names,
        rank=node["rank"],
        singular_values=np.array(node["singular_values"]),
        null_vectors=np.array(vectors) if vectors else np.zeros((0, len(names))),
        identifiable=np.array(node["identifiable"]),
        directions=[_direction(entry) for entry in node["directions"]],
        near_null=[_direction(entry) for entry in node.get("near_null", [])],
        sampling=list(node["sampling"]),
        mirrors=list(node["mirrors"]),
        branches=plain(node.get("branches", [])),
    )


def _by_name(entries, key="name"):
    """Return entries by name; of two of one name only one would be left."""
    found = {entry[key]: entry for entry in entries}
    if len(found) < len(entries):
        names = [entry[key] for entry in entries]
        twice = next(name for name in names if names.count(name) > 1)
        raise CalibrationFileError(f"{twice!r} is given twice in a list of parameters")
    return found


def _direction(node):
    from astropolcal.converters.nodes import plain

    return {
        "words": node["words"],
        "parameters": {k: entry["value"] for k, entry in _by_name(node["parameters"]).items()},
        **({"sky": plain(node["sky"])} if "sky" in node else {}),
    }


def _dataset(node):
    from astropolcal.calibration import DatasetRecord
    from astropolcal.converters.nodes import plain, table_from_node

    accuracy = table_from_node(node["accuracy"])
    return DatasetRecord(**(node | {"meta": plain(node["meta"]), "accuracy": accuracy}))


def _tie(node):
    import numpy as np

    from astropolcal.converters.nodes import value_from_node
    from astropolcal.measurement.parameters import Tie

    offset = value_from_node(node["offset"])
    # a number of its own type, as it was given
    plain_number = "unit" not in node["offset"] and not np.ndim(offset)
    return Tie(node["source"], node["factor"], offset.item() if plain_number else offset)


def _stage(node):
    from astropolcal.converters.nodes import value_from_node

    parameters = node["parameters"]
    return {
        "title": node["title"],
        "parameters": {k: value_from_node(entry) for k, entry in _by_name(parameters).items()},
        "residual_rms": node["residual_rms"],
    }
