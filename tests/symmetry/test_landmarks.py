"""torchqm.symmetry.landmarks: peaks and permutations against slow twins, tips of creatures, only the metric counts."""

from functools import lru_cache
from itertools import permutations, product

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from references.pairs import reordered, with_loose_vertices
from references.shapes import basis_of, icosphere, rotation

from torchqm.data.synthetic import creature
from torchqm.geometry import Mesh, area_samples, distances, laplacian
from torchqm.spectral import mesh_basis
from torchqm.symmetry.landmarks import (
    LandmarkPermutation,
    Landmarks,
    find_landmarks,
    green_functions,
    landmark_permutations,
    peaks,
)

N_TIPS = {"biped": 5, "quadruped": 6, "ellipsoid": 6, "octopus": 8}


def slow_peaks(mesh, heights):
    """Vertices from the top down (of equal ones the last first), each joined with its higher neighbours."""
    near = {v: set() for face in mesh.faces.tolist() for v in face}
    for face in mesh.faces.tolist():
        for a, b in product(face, face):
            near[a] |= {b} - {a}
    above, died = {}, {}
    for v in sorted(near, key=lambda v: (-heights[v], -v)):
        tops = list(dict.fromkeys(above[u] for u in near[v] if u in above))
        tops.sort(key=lambda t: (-heights[t], -t))
        for low in tops[1:]:
            died[low] = heights[low] - heights[v]
            above = {u: tops[0] if t == low else t for u, t in above.items()}
        above[v] = tops[0] if tops else v
    for top in set(above.values()):
        died[top] = heights[top] - min(heights[u] for u, t in above.items() if t == top)
    order = sorted(died, key=lambda t: (-died[t], t))
    return order, [died[t] for t in order]


def flat(n, faces):
    """Where the vertices lie says nothing here."""
    return Mesh.from_arrays([[v, v * v, 0] for v in range(n)], faces)


@st.composite
def surfaces(draw):
    """Triangles between few vertices at random: several components, unused vertices, edges of many triangles."""
    n = draw(st.integers(4, 14))
    faces = draw(
        st.lists(st.lists(st.integers(0, n - 1), min_size=3, max_size=3, unique=True), min_size=1, max_size=16)
    )
    heights = draw(st.lists(st.integers(-3, 3), min_size=n, max_size=n))
    return flat(n, faces), [float(h) for h in heights]


class TestPeaks:
    @given(surfaces())
    def test_is_the_slow_twin(self, drawn):
        mesh, heights = drawn
        ids, persistence = peaks(mesh, torch.tensor(heights).double())
        assert (ids.tolist(), persistence.tolist()) == slow_peaks(mesh, heights)

    @pytest.mark.parametrize("seed", range(3))
    def test_noise_on_a_blob(self, mirror_blob, seed):
        heights = torch.randn(642, generator=torch.Generator().manual_seed(seed)).double()
        ids, persistence = peaks(mirror_blob.mesh, heights)
        assert (ids.tolist(), persistence.tolist()) == slow_peaks(mirror_blob.mesh, heights.tolist())
        assert len(ids) > 50

    def test_a_sphere_seen_from_above(self, sphere):
        ids, persistence = peaks(sphere, sphere.verts[:, 2])
        assert sphere.verts[ids, 2].tolist() == [1.0]
        assert persistence.tolist() == [2.0]

    def test_each_component_has_a_peak_that_stays(self):
        pair = flat(6, [[0, 1, 2], [3, 4, 5]])
        ids, persistence = peaks(pair, torch.tensor([1.0, 2.0, 4.0, 5.0, 3.0, 4.5]))
        assert ids.tolist() == [2, 3]
        assert persistence.tolist() == [3.0, 2.0]

    def test_vertices_of_no_triangle_are_no_peaks_and_no_valleys(self):
        ids, persistence = peaks(flat(5, [[1, 2, 3]]), torch.tensor([9.0, 1.0, 2.0, 3.0, -9.0]))
        assert ids.tolist() == [3]
        assert persistence.tolist() == [2.0]

    def test_a_plateau_has_no_height(self, sphere):
        _, persistence = peaks(sphere, torch.ones(642))
        assert set(persistence.tolist()) == {0.0}
        assert persistence.dtype == torch.float32
        top = sphere.verts[:, 2].clamp_max(0.5)
        assert sorted(set(peaks(sphere, top)[1].tolist())) == [0.0, 1.5]


class TestGreenFunctions:
    @pytest.mark.parametrize("power", [1.0, 2.0, 0.5])
    def test_is_the_sum(self, mirror_blob, power):
        basis = basis_of(mirror_blob.mesh, 30)
        ids = torch.tensor([5, 17, 400])
        found = green_functions(basis, ids, power, 12)
        for column, p in enumerate(ids.tolist()):
            terms = [basis.evals[i] ** -power * basis.evecs[p, i] * basis.evecs[:, i] for i in range(1, 12)]
            torch.testing.assert_close(found[:, column], sum(terms), atol=1e-13, rtol=1e-12)

    def test_inverts_the_laplacian(self):
        """With all functions: ``Delta G_p = delta_p - 1 / area``, and the biharmonic one is G of G."""
        mesh = icosphere(1)
        operator = laplacian(mesh)
        basis, ids = mesh_basis(mesh, 42), torch.arange(42)
        green = green_functions(basis, ids, k=42)
        wanted = torch.eye(42).double() - operator.mass[:, None] / operator.mass.sum()
        torch.testing.assert_close(operator.stiffness.to_dense() @ green, wanted, atol=1e-10, rtol=0)
        torch.testing.assert_close(
            green_functions(basis, ids, 2.0, 42), green @ (operator.mass[:, None] * green), atol=1e-10, rtol=0
        )

    def test_no_more_functions_than_there_are(self, mirror_blob):
        basis, ids = basis_of(mirror_blob.mesh, 30), torch.tensor([3])
        assert torch.equal(green_functions(basis, ids, k=999), green_functions(basis, ids, k=30))


@lru_cache
def rest(kind):
    body = creature(kind, 1000)
    mesh = body.mesh.normalized()
    return body, find_landmarks(mesh, basis_of(mesh, 100))


@pytest.fixture(scope="module")
def posed():
    """No two heights are equal, so that the tips have one order."""
    mesh = creature("quadruped", 1000, 0, 1).mesh.normalized()
    return mesh, find_landmarks(mesh, basis_of(mesh, 100))


class TestFindLandmarks:
    @pytest.mark.parametrize("kind", N_TIPS)
    def test_tips_of_the_creatures(self, kind):
        """Each is far from everywhere on the surface: farther than nearly all that is around it."""
        body, found = rest(kind)
        assert found.n == N_TIPS[kind] == len(found.heights)
        assert bool((found.heights.diff() <= 1e-12).all())
        mesh = body.mesh.normalized()
        far = distances(mesh, area_samples(mesh, 60, 0), "dijkstra").mean(0)
        for tip in found.tips:
            around = distances(mesh, tip, "dijkstra").amin(0) < 0.15
            assert float((far[tip].max() >= far[around]).double().mean()) > 0.7

    @pytest.mark.parametrize("kind", N_TIPS)
    def test_symmetries_permute_the_tips(self, kind):
        body, found = rest(kind)
        tips = {frozenset(t.tolist()) for t in found.tips}
        for element in body.base_group:
            assert {frozenset(element[t].tolist()) for t in found.tips} == tips

    def test_volumes_are_alternating(self, posed):
        volumes = posed[1].volumes
        for order in permutations(range(3)):
            even = order in {(0, 1, 2), (1, 2, 0), (2, 0, 1)}
            torch.testing.assert_close(volumes.permute(order), volumes if even else -volumes, atol=1e-12, rtol=0)
        assert 0.05 * posed[1].volume_scale < float(volumes.norm()) <= posed[1].volume_scale

    def test_distances_are_those_of_the_green_functions(self, posed):
        """``d(p, q)^2 = G2(p, p) - 2 G2(p, q) + G2(q, q)`` with the biharmonic Green's function."""
        mesh, found = posed
        alone = [i for i, tip in enumerate(found.tips) if len(tip) == 1]
        ids = torch.cat([found.tips[i] for i in alone])
        green = green_functions(basis_of(mesh, 100), ids, 2.0)[ids]
        own = green.diagonal()
        distances = found.distances[alone][:, alone]
        torch.testing.assert_close(distances.square(), own[:, None] + own - 2 * green, atol=1e-12, rtol=0)
        assert len(alone) > 3

    def test_the_numbering_does_not_matter(self, posed):
        mesh, found = posed
        copy, _, new = reordered(mesh, 3)
        self.same(find_landmarks(copy, mesh_basis(copy, 100)), found, new)

    def test_vertices_of_no_triangle_do_not_matter(self, posed):
        mesh, found = posed
        copy, new = with_loose_vertices(mesh, [0, 7, mesh.n_verts])
        self.same(find_landmarks(copy, mesh_basis(copy, 100)), found, new)

    def test_how_it_lies_in_space_does_not_matter(self, posed):
        mesh, found = posed
        copy = mesh.moved(mesh.verts @ rotation(4).T + 3)
        self.same(find_landmarks(copy, mesh_basis(copy, 100)), found, torch.arange(mesh.n_verts))

    @staticmethod
    def same(one, other, new):
        assert [t.tolist() for t in one.tips] == [new[t].tolist() for t in other.tips]
        for name in ("heights", "distances", "volumes"):
            torch.testing.assert_close(getattr(one, name), getattr(other, name), atol=1e-7, rtol=1e-7)
        assert one.volume_scale == pytest.approx(other.volume_scale)

    def test_inside_out_the_volumes_change_sign(self, posed):
        mesh, found = posed
        turned = find_landmarks(Mesh(mesh.verts, mesh.faces.flip(1)), basis_of(mesh, 100))
        torch.testing.assert_close(turned.volumes, -found.volumes, atol=1e-12, rtol=0)
        assert torch.equal(turned.distances, found.distances)

    def test_near_tips_are_one(self, posed):
        """All within the largest distance of the first are one landmark; with no distance each is its own."""
        mesh, found = posed
        basis = basis_of(mesh, 100)
        one = find_landmarks(mesh, basis, apart=1.0)
        assert one.n == 1
        split = find_landmarks(mesh, basis, apart=0.0, most=16)
        assert split.n == sum(len(t) for t in found.tips) == len(one.tips[0])
        assert torch.equal(torch.cat(split.tips).sort().values, one.tips[0].sort().values)
        assert find_landmarks(mesh, basis, most=3).n == 3


def true_permutations(body, found):
    """Images and orientation for each element of the exact group."""
    number = {v: a for a, tip in enumerate(found.tips) for v in tip.tolist()}
    images = [tuple(number[int(element[tip[0]])] for tip in found.tips) for element in body.base_group]
    return list(zip(images, body.orientation.tolist(), strict=True))


def landmarks_at(points, heights=None):
    """Points in space: their distances and determinants behave like those of landmarks."""
    n = len(points)
    a, b = points[:, None].expand(n, n, 3), points[None].expand(n, n, 3)
    volumes = torch.linalg.cross(a, b) @ points.T
    tips = tuple(torch.tensor([i]) for i in range(n))
    heights = torch.ones(n).double() if heights is None else heights
    return Landmarks(tips, heights, torch.cdist(points, points), volumes, 1.5 * float(volumes.norm()))


def random_landmarks(n, seed=0):
    generator = torch.Generator().manual_seed(seed)
    points = torch.randn(n, 3, generator=generator).double()
    return landmarks_at(points, 1 + torch.rand(n, generator=generator).double())


ANY = {"rtol_height": 9.0, "rtol_distance": 9.0, "width": 9999, "most": 9999}


class TestPermutations:
    @pytest.mark.parametrize("kind", N_TIPS)
    def test_true_symmetries_cost_nothing(self, kind):
        body, found = rest(kind)
        proposed = landmark_permutations(found)
        costs = {(p.images, p.orientation): p.cost for p in proposed}
        assert len(costs) == len(proposed)
        first, *others = true_permutations(body, found)
        assert first == (tuple(range(found.n)), 1)
        assert first not in costs
        for true in others:
            assert costs[true] < 1e-12

    @pytest.mark.parametrize("kind", ["biped", "quadruped"])
    def test_the_reflection_is_the_best(self, kind):
        """By far: the next one costs ten thousand times as much, and turns the orientation the right way."""
        body, found = rest(kind)
        best, second = landmark_permutations(found)[:2]
        assert (best.images, best.orientation) == true_permutations(body, found)[1]
        assert best.cost < 1e-20
        assert best.involutive
        assert second.cost > 1e-6

    @pytest.mark.parametrize("seed", [0, 1])
    def test_all_costs_of_a_few_landmarks(self, seed):
        """``|D - P D|^2 / |D|^2 + |W -+ P W|^2 / scale^2``, for all 48 but the identity."""
        found = random_landmarks(4, seed)
        proposed = landmark_permutations(found, **ANY)
        costs = [p.cost for p in proposed]
        assert costs == sorted(costs)
        assert len({(p.images, p.orientation) for p in proposed}) == len(proposed) == 47
        d, w = found.distances, found.volumes
        for p in proposed:
            images = torch.tensor(p.images)
            wanted = (d - d[images][:, images]).square().sum() / d.square().sum()
            turned = w - p.orientation * w[images][:, images][:, :, images]
            wanted += turned.square().sum() / found.volume_scale**2
            assert p.cost == pytest.approx(float(wanted), rel=1e-9)

    def test_a_narrow_beam_finds_the_best_of_a_mirrored_set(self):
        """Four points and their mirror images in another order: of 8! permutations the one that costs nothing."""
        half = torch.randn(4, 3, generator=torch.Generator().manual_seed(5)).double()
        points = torch.cat([half, half * torch.tensor([-1.0, 1.0, 1.0])])[
            torch.randperm(8, generator=torch.Generator().manual_seed(6))
        ]
        places = points.tolist()
        mirror = tuple(places.index([-x, y, z]) for x, y, z in places)
        found = landmarks_at(points)
        best = landmark_permutations(found, width=30)[0]
        assert (best.images, best.orientation) == (mirror, -1)
        assert best.cost < 1e-20

    def test_different_heights_are_not_exchanged(self):
        """Of two landmarks e^0.3 is the limit: just below and just above."""
        for ratio, wanted in ((0.29, {(1, 0), (0, 1)}), (0.31, {(0, 1)})):
            pair = random_landmarks(2)
            heights = torch.tensor([0.0, ratio]).double().exp()
            pair = Landmarks(pair.tips, heights, pair.distances, pair.volumes, 1.0)
            assert {p.images for p in landmark_permutations(pair)} == wanted

    def test_changed_distances_end_a_permutation(self):
        found = random_landmarks(4)
        d, average = found.distances, float(found.distances.sum()) / 12
        for p in landmark_permutations(found, **(ANY | {"rtol_distance": 0.4})):
            other = d[list(p.images)][:, list(p.images)]
            assert bool(((d - other).abs() <= 0.4 * ((d + other) / 2 + average) / 2 + 1e-12).all())
        assert len(landmark_permutations(found, **(ANY | {"rtol_distance": 0.0}))) == 1  # all where they are, turned

    def test_flat_shapes_are_proposed_with_both_orientations(self):
        """Without volumes nothing tells a rotation from a reflection, not even from the identity."""
        found = random_landmarks(4)
        flat = Landmarks(found.tips, found.heights, found.distances, 0 * found.volumes, 0.0)
        first = landmark_permutations(flat, **ANY)[0]
        assert (first.images, first.orientation, first.cost) == ((0, 1, 2, 3), -1, 0.0)
        few = {(p.images, p.orientation) for p in landmark_permutations(found, **(ANY | {"most": 3, "both": 3}))}
        assert all((images, -o) in few or images == (0, 1, 2, 3) for images, o in few)

    @pytest.mark.parametrize("n", [1, 2])
    def test_few_landmarks(self, n):
        proposed = landmark_permutations(random_landmarks(n), **ANY)
        assert {p.cost for p in proposed} == {0.0}
        identity = (tuple(range(n)), 1)
        wanted = set(product(permutations(range(n)), (1, -1))) - {identity}
        assert {(p.images, p.orientation) for p in proposed} == wanted

    def test_involutions_and_the_identity(self):
        assert LandmarkPermutation((1, 0, 2), -1, 0.0).involutive
        assert not LandmarkPermutation((1, 2, 0), 1, 0.0).involutive
        assert LandmarkPermutation((0, 1, 2), 1, 0.0).trivial
        assert not LandmarkPermutation((0, 1, 2), -1, 0.0).trivial
        assert not LandmarkPermutation((1, 0, 2), 1, 0.0).trivial
