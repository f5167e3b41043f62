# Licensed under a 3-clause BSD style license - see LICENSE
"""
Priors in a calibration file.

A prior belongs to a parameter, in whatever chain its optic stands; so the file
lists priors by the parameter's name, beside the chains.
"""

from astropolcal.exceptions import CalibrationFileError

__all__ = ["node_from_priors", "restore_priors", "without_priors"]

_OURS = {"normal": ("mean", "std"), "uniform": ("low", "high")}


def node_from_priors(chains):
    """
    Return the priors of the chains' parameters.

    Parameters
    ----------
    chains : sequence
        The chains.

    Returns
    -------
    list of dict
        ``parameter`` and ``kind``, with ``mean`` and ``std``, ``low`` and
        ``high``, or ``distribution``, ``args`` and ``kwds`` of `scipy.stats`.

    Raises
    ------
    CalibrationFileError
        If a prior is no `~astropolcal.measurement.Normal`,
        ``Uniform`` or frozen continuous distribution.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import optics
    >>> from astropolcal.converters.priors import node_from_priors
    >>> from astropolcal.measurement import Normal
    >>> hwp = optics.TwoLayerWaveplate(name="hwp")
    >>> hwp.theta.prior = Normal(0 * u.deg, 6 * u.arcmin)
    >>> node_from_priors([hwp])[0]["std"]
    {'value': 6.0, 'unit': 'arcmin'}
    """
    from astropolcal.measurement import parameter_table

    # one entry a parameter: chains share the optics that stand in several of them
    table = parameter_table(chains).items()
    return [
        {"parameter": name} | prior_node(parameters[0].prior, name)
        for name, parameters in table
        if parameters[0].prior is not None
    ]


def prior_node(prior, name):
    """Return the node of a prior."""
    from astropolcal.converters.nodes import node_from_value

    kind = type(prior).__name__.lower()
    if type(prior).__module__ == "astropolcal.measurement.priors" and kind in _OURS:
        values = {key: node_from_value(getattr(prior, key)) for key in _OURS[kind]}
        return {"kind": kind} | values
    return {"kind": "scipy"} | _frozen_node(prior, name)


def _frozen_node(prior, name):
    from astropolcal.converters.nodes import plain

    node = {
        "distribution": getattr(getattr(prior, "dist", None), "name", None),
        "args": plain(list(getattr(prior, "args", ())), f"prior of {name}"),
        "kwds": plain(dict(getattr(prior, "kwds", {})), f"prior of {name}"),
    }
    try:
        _frozen(node)
    except (TypeError, ValueError):
        raise CalibrationFileError(
            f"prior of {name} is a {type(prior).__name__}, which files cannot hold; allowed are "
            "Normal, Uniform and frozen continuous distributions of scipy.stats"
        ) from None
    return node


def _frozen(node):
    """Return the distribution of a node; nothing but those of scipy can be named."""
    import scipy.stats

    name = node["distribution"]
    # names of modules and functions are there too: only distributions pass the next line
    family = getattr(scipy.stats, name, None) if isinstance(name, str) else None
    if not isinstance(family, scipy.stats.rv_continuous):
        raise ValueError(f"scipy.stats has no continuous distribution {name!r}")
    found = family(*node["args"], **node["kwds"])
    # scipy looks at the parameters when they are used, and gives NaN for those that cannot be
    low, high = found.support()
    if not low < high:
        raise ValueError(f"{name} of {node['args']} and {node['kwds']} is no distribution")
    return found


def without_priors(chain):
    """
    Return a copy of a chain whose parameters have no priors.

    Parameters
    ----------
    chain : Optic or `~astropy.modeling.CompoundModel`
        The chain; it is not changed.

    Returns
    -------
    Optic or `~astropy.modeling.CompoundModel`

    Examples
    --------
    >>> from astropolcal import optics
    >>> from astropolcal.converters.priors import without_priors
    >>> without_priors(optics.Rotator(name="r")).theta.prior is None
    True
    """
    from astropolcal.measurement import parameter_table

    copy = chain.copy()
    for parameters in parameter_table([copy]).values():
        for parameter in parameters:
            parameter.prior = None
    return copy


def restore_priors(chains, nodes):
    """
    Give the parameters of chains the priors that `node_from_priors` wrote.

    Parameters
    ----------
    chains : sequence
        The chains, which are changed.
    nodes : list of dict
        The priors.

    Raises
    ------
    CalibrationFileError
        If no chain has such a parameter, or there is no such distribution.

    Examples
    --------
    >>> from astropolcal import optics
    >>> from astropolcal.converters.priors import restore_priors
    >>> rotator = optics.Rotator(name="r")
    >>> bound = {"value": 1.0, "unit": "deg"}
    >>> restore_priors([rotator], [{"parameter": "r.theta", "kind": "normal", "mean": bound,
    ...                             "std": bound}])
    >>> rotator.theta.prior.std
    <Quantity 1. deg>
    """
    from astropolcal.measurement import parameter_table

    table, seen = parameter_table(chains), set()
    for node in nodes:
        if node["parameter"] in seen:
            raise CalibrationFileError(f"prior of {node['parameter']!r} is given twice")
        seen.add(node["parameter"])
        if node["parameter"] not in table:
            raise CalibrationFileError(f"prior of {node['parameter']!r}, which no chain has")
        for parameter in table[node["parameter"]]:
            parameter.prior = prior_from_node(node, node["parameter"])


def prior_from_node(node, name):
    """Return the prior of a node."""
    try:
        return _prior(node, name)
    except (KeyError, TypeError, AttributeError) as error:
        raise CalibrationFileError(f"prior of {name}: {type(error).__name__}, {error}") from None


def _prior(node, name):
    from astropolcal.converters.nodes import plain, value_from_node
    from astropolcal.measurement import priors

    if node["kind"] == "scipy":
        try:
            return _frozen(plain(node))
        except (TypeError, ValueError) as error:
            raise CalibrationFileError(f"prior of {name}: {error}") from None
    values = [value_from_node(node[key]) for key in _OURS[node["kind"]]]
    # a number of its own type, as it was given
    values = [v if hasattr(v, "unit") else v.item() for v in values]
    return getattr(priors, node["kind"].capitalize())(*values)
