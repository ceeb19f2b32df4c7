"""Connected components."""

import numpy as np

from factorsfm.support.components import connected_components


def test_a_long_path_in_any_order_is_one_component():
    rng = np.random.default_rng(0)
    nodes = rng.permutation(200)
    edges = np.stack([nodes[:-1], nodes[1:]], 1)[rng.permutation(199)]
    assert not connected_components(200, edges).any()


def test_components_bear_their_smallest_node():
    edges = np.array([[5, 3], [3, 4], [7, 1], [2, 2]])
    assert connected_components(8, edges).tolist() == [0, 1, 2, 3, 3, 3, 6, 1]


def test_without_edges_every_node_is_alone():
    assert connected_components(3, np.zeros((0, 2), np.int64)).tolist() == [0, 1, 2]
