# Licensed under a 3-clause BSD style license - see LICENSE
"""Pages of the model gallery, written from the registries when the documentation is built."""
