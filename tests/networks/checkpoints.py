"""Networks with the tensors of checkpoints, through the published keys."""

from mfvpr.checkpoints.conversion import convert
from mfvpr.checkpoints.networks import NETWORKS, plan_network


def fill(build, table, tensors):
    """The network of a constructor."""
    plan = plan_network(build)
    return plan.build(convert(tensors, table, plan.shapes))


def fill_published(name, tensors):
    """The network of a name in the registry."""
    return fill(NETWORKS[name].builder(), NETWORKS[name].table, tensors)
