"""All the good maps between two meshes, in five lines; here two built-in creatures, so that the answer is known.

python examples/match_two_creatures.py
"""

import torchqm
from torchqm.evaluate import geodesic_errors, spread_points

source = torchqm.creature("biped", 1000, pose=1, retriangulate=1)
target = torchqm.creature("biped", 1000)
result = torchqm.match(source.mesh, target.mesh)

at = spread_points(source.mesh, 50)
truth = torchqm.exact_maps(source, target).nearest_vertices()[:, at]
for label, score, p2p, true in zip(result.labels, result.scores, result.maps, truth, strict=True):
    error = geodesic_errors(target.mesh, p2p, true, at).mean()
    print(f"{label:9s} score {score:.4f}   mean error {error:.4f} sqrt(area)")
for warning in result.warnings:
    print("warning:", warning)
