# Licensed under a 3-clause BSD style license - see LICENSE
"""Reading ASDF files in these tests."""

import asdf.schema
import pytest


@pytest.fixture(scope="module")
def kept_schemas():
    """Let ASDF parse each of its schemas once: that is most of the time of reading a file."""
    real, known = asdf.schema._make_schema_loader, {}

    def make():
        load = real()

        def kept(url):
            if url not in known:
                known[url] = load(url)
            return known[url]

        return kept

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(asdf.schema, "_make_schema_loader", make)
        yield
