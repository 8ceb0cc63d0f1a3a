"""torchqm.symmetry.domains: domains of exact groups against nearest images, and of bent shapes, where these fail."""

import pytest
import torch
from references.shapes import basis_of, blob, prism
from references.unchecked import unchecked

from torchqm.data import creature
from torchqm.symmetry import SymmetryGroup, fundamental_domains

SHAPES = [blob(2), blob(4), blob(8), prism()]


@pytest.fixture(params=SHAPES, ids=["mirror", "two mirrors", "three mirrors", "prism"])
def shape(request):
    return request.param


def free(group):
    """Vertices that no element but the identity keeps."""
    return (group.maps[1:] != group.maps[0]).all(0)


def are_images(element, group, products):
    """Whether g(x) lies in the image under g of the domain of x, for all elements and vertices, ``(G, V)``."""
    return element[group.maps] == products[:, element]


def test_nearest_image_of_the_start(shape):
    mesh, group = shape
    found = fundamental_domains(group, mesh.verts, mesh.vertex_areas)
    assert torch.equal(found.centres, group.maps[:, found.start])
    assert found.element[found.centres].tolist() == list(range(group.order))
    distances = torch.cdist(mesh.verts, mesh.verts[found.centres], compute_mode="donot_use_mm_for_euclid_dist")
    lowest = (distances < distances.amin(1, keepdim=True) + 1e-9).int().argmax(1)  # ties to the lowest element
    assert torch.equal(found.element, lowest)


def test_domains_are_images_of_each_other(shape):
    mesh, group = shape
    found = fundamental_domains(group, mesh.verts, mesh.vertex_areas)
    products = group.residuals(mesh.verts).products
    assert bool(are_images(found.element, group, products)[:, free(group)].all())
    torch.testing.assert_close(found.shares, torch.full((group.order,), 1 / group.order, dtype=torch.float64))
    assert found.imbalance < 1e-9
    assert bool((free(group) | found.boundary).all())


def test_shares_are_areas():
    mirror = SymmetryGroup(torch.tensor([[0, 1, 2, 3], [1, 0, 2, 3]]))
    points = torch.tensor([[-1.0], [1.0], [0.0], [0.0]])
    found = fundamental_domains(mirror, points, torch.tensor([3.0, 1.0, 2.0, 2.0]))
    assert (found.element.tolist(), found.boundary.tolist()) == ([0, 1, 0, 0], [False, False, True, True])
    assert found.shares.tolist() == [5 / 8, 3 / 8]  # what lies on the axis belongs half to either side
    assert found.imbalance == pytest.approx(1 / 4)


def test_start_has_its_images_farthest_apart(shape):
    mesh, group = shape
    found = fundamental_domains(group, mesh.verts, mesh.vertex_areas)
    orbits = mesh.verts[group.orbits]
    apart = torch.cdist(orbits, orbits) + 1e9 * torch.eye(group.order, dtype=torch.float64)
    smallest = apart.amin((1, 2))
    assert found.separation == pytest.approx(float(smallest.max()))
    ties = (smallest > smallest.max() - 1e-6).nonzero()[:, 0].tolist()
    assert found.start == ties[0]
    assert set(group.orbits[found.start].tolist()) <= set(ties)


def test_the_mirror_of_a_mirror():
    mesh, group = blob(2)
    found = fundamental_domains(group, mesh.verts, mesh.vertex_areas)
    x = mesh.verts[:, 0] * mesh.verts[found.start, 0].sign()
    assert torch.equal(found.element, (x < -1e-9).long())


def test_a_given_start():
    mesh, group = blob(4)
    start = int(free(group).nonzero()[5])
    found = fundamental_domains(group, mesh.verts, mesh.vertex_areas, start)
    assert (found.start, int(found.element[start])) == (start, 0)
    again = fundamental_domains(group, mesh.verts, mesh.vertex_areas, start, group.residuals(mesh.verts).products)
    assert torch.equal(found.element, again.element)
    kept = int((~free(group)).nonzero()[0])
    with pytest.raises(ValueError, match=f"two elements send vertex {kept} to the same place"):
        fundamental_domains(group, mesh.verts, mesh.vertex_areas, kept)


def test_vertices_without_area_are_never_the_start():
    mesh, group = blob(2)
    first = fundamental_domains(group, mesh.verts, mesh.vertex_areas).start
    weights = mesh.vertex_areas.clone()
    weights[group.orbits[first]] = 0
    assert fundamental_domains(group, mesh.verts, weights).start not in group.orbits[first]


def test_any_points_give_domains_that_are_images():
    """The group is exact, the points know nothing of it: nearest images would not be images of each other."""
    group = prism().group
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(group.n_verts, 3, dtype=torch.float64, generator=generator)
    products = group.residuals(points).products
    found = fundamental_domains(group, points, torch.ones(group.n_verts, dtype=torch.float64))
    assert bool(are_images(found.element, group, products)[:, free(group)].all())
    nearest = torch.cdist(points, points[found.centres]).argmin(1)
    assert not bool(are_images(nearest, group, products)[:, free(group)].all())


def test_left_and_right_of_a_bent_biped():
    """Poses are not isometric: the nearest of two images cuts the body beside its middle, the domains do not."""
    biped = creature("biped", n_verts=1000, pose=1)
    group = SymmetryGroup(biped.base_group)
    basis = basis_of(biped.mesh, 40)
    points = basis.evecs[:, 1:] / basis.evals[1:]
    found = fundamental_domains(group, points, basis.mass)
    x = biped.rest.verts[:, 0] * biped.rest.verts[found.start, 0].sign()
    right = (found.element == 0) == (x > 0)
    off_axis = free(group)
    assert float(basis.mass[right & off_axis].sum() / basis.mass[off_axis].sum()) > 0.98
    nearest = torch.cdist(points, points[found.centres]).argmin(1)
    right = (nearest == 0) == (x > 0)
    assert float(basis.mass[right & off_axis].sum() / basis.mass[off_axis].sum()) < 0.95


def test_trivial_group():
    mesh = blob(1).mesh
    weights = mesh.vertex_areas.clone()
    weights[0] = 0
    found = fundamental_domains(SymmetryGroup.trivial(642), mesh.verts, weights)
    assert (found.start, found.separation, found.centres.tolist()) == (1, float("inf"), [1])
    assert int(found.element.max()) == 0
    assert found.imbalance < 1e-12


def test_refusals():
    make = unchecked(fundamental_domains)
    mirror = SymmetryGroup(torch.tensor([[0, 1], [1, 0]]))
    points, weights = torch.tensor([[0.0], [1.0]]), torch.ones(2)
    with pytest.raises(ValueError, match="3 points and 2 weights, but the group acts on 2 vertices"):
        make(mirror, torch.zeros(3, 1), weights)
    with pytest.raises(ValueError, match="weights: none is positive"):
        make(mirror, points, torch.zeros(2))
    with pytest.raises(ValueError, match="start is 2, allowed are 0 to 1"):
        make(mirror, points, weights, 2)
    with pytest.raises(ValueError, match="no domain for each of the 2 elements"):
        make(mirror, torch.ones(2, 1), weights, products=torch.tensor([[0, 1], [1, 0]]))
    with pytest.raises(ValueError, match="it has 1 elements, the symmetry 2"):
        make(mirror, points, weights, products=torch.zeros(1, 1, dtype=torch.int64))
    fold = SymmetryGroup(torch.tensor([[0, 1], [0, 0]]))
    with pytest.raises(ValueError, match=r"does not belong to the group: row 1 .* Latin square"):
        make(fold, points, weights)
