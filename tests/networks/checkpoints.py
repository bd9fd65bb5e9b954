"""Networks with the tensors of checkpoints, through the published keys."""

from functools import partial

from mfvpr.checkpoints.conversion import TABLES, convert
from mfvpr.checkpoints.networks import entry_of, plan_network
from mfvpr.networks import VggNetVlad
from tests.random_checkpoints import netvlad_shapes, random_checkpoint


def fill(build, table, tensors):
    """The network of a constructor."""
    plan = plan_network(build)
    return plan.build(convert(tensors, table, plan.shapes))


def fill_published(name, tensors):
    """The network of a name in the registry."""
    entry = entry_of(name)
    return fill(entry.builder(), entry.table, tensors)


def fill_netvlad(clusters, outputs, seed=0):
    """NetVLAD's network with random tensors."""
    tensors = random_checkpoint(netvlad_shapes(clusters, outputs), seed)
    return fill(partial(VggNetVlad, clusters, outputs), TABLES["netvlad"], tensors)
