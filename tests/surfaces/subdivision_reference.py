"""Catmull–Clark and Loop subdivision with creases, corners and boundaries, and limit masks: plain and slow."""

from __future__ import annotations

import numpy as np

INFINITE = 10.0


class Cage:
    """A cage under subdivision. Each corner of each face knows where it is in the parameters of the face it came from.

    vertices (V, 3); faces: lists of vertices; creases {frozenset of two vertices: sharpness}; corners {vertex:
    sharpness}; places: for each face the number of its first ancestor and its corners' parameters (k, 2) there.
    """

    def __init__(self, vertices, faces, scheme, creases=(), corners=(), boundary="edge_and_corner"):
        self.vertices, self.faces, self.scheme = np.asarray(vertices, float), [list(f) for f in faces], scheme
        self.creases = {frozenset((int(a), int(b))): float(s) for a, b, s in creases}
        self.corners = {int(v): float(s) for v, s in corners}
        self.places = [(i, domain(scheme, len(f))) for i, f in enumerate(self.faces)]
        around = self.edges()
        self.creases |= {e: INFINITE for e, near in around.items() if len(near) == 1}
        if boundary == "edge_and_corner":
            count = np.bincount([v for f in self.faces for v in f])
            self.corners |= {v: INFINITE for e, near in around.items() if len(near) == 1 for v in e if count[v] == 1}

    def edges(self):
        """Each edge's faces."""
        edges = {}
        for i, face in enumerate(self.faces):
            for a, b in zip(face, face[1:] + face[:1], strict=True):
                edges.setdefault(frozenset((a, b)), []).append(i)
        return edges

    def refined(self):
        v, around = self.vertices, self.edges()
        child = Cage.__new__(Cage)
        child.scheme, child.corners = self.scheme, {k: softer(s) for k, s in self.corners.items() if softer(s) > 0}
        centers = np.array([v[f].mean(axis=0) for f in self.faces])
        number = {e: len(v) + i for i, e in enumerate(around)}
        middles = []
        for e, near in around.items():
            sharp, (a, b) = self.creases.get(e, 0.0), e
            middle = (v[a] + v[b]) / 2
            if sharp < 1:
                if self.scheme == "catmark":
                    smooth = (v[a] + v[b] + centers[near].sum(axis=0)) / 4
                else:
                    ends = [next(x for x in self.faces[f] if x not in e) for f in near]
                    smooth = 3 / 8 * (v[a] + v[b]) + v[ends].sum(axis=0) / 8
                middle = sharp * middle + (1 - sharp) * smooth
            middles.append(middle)
        child.creases = {}
        for e, sharp in self.creases.items():
            if softer(sharp) > 0:
                child.creases |= {frozenset((x, number[e])): softer(sharp) for x in e}
        moved = self.moved(centers, around, child)
        child.faces, child.places = [], []
        first = len(v) + len(around)
        for i, (face, (root, at)) in enumerate(zip(self.faces, self.places, strict=True)):
            k = len(face)
            mids = [number[frozenset((face[j], face[(j + 1) % k]))] for j in range(k)]
            half = (at + np.roll(at, -1, axis=0)) / 2
            if self.scheme == "loop":
                child.faces += [[face[j], mids[j], mids[j - 1]] for j in range(3)] + [mids]
                child.places += [(root, np.array([at[j], half[j], half[j - 1]])) for j in range(3)] + [(root, half)]
                continue
            child.faces += [[face[j], mids[j], first + i, mids[j - 1]] for j in range(k)]
            for j in range(k):
                # The sub-faces of what is no quadrilateral lie apart, with axes of their own.
                own = np.array([at[j], half[j], at.mean(axis=0), half[j - 1]])
                child.places.append((root, own if k == 4 else at[j] + [(0, 0), (0.5, 0), (0.5, 0.5), (0, 0.5)]))
        points = [moved, np.array(middles), *([centers] if self.scheme == "catmark" else [])]
        child.vertices = np.concatenate(points)
        return child

    def moved(self, centers, around, child):
        """Where vertices go: their own rule, or between it and that of the next level where sharpness ends."""
        v = self.vertices
        edges, near = [[] for _ in v], [[] for _ in v]
        for e in around:
            for x in e:
                edges[x].append(e)
        for i, face in enumerate(self.faces):
            for x in face:
                near[x].append(i)
        out = v.copy()
        for x in range(len(v)):
            if not near[x]:
                continue
            now = {e: self.creases.get(e, 0.0) for e in edges[x]}
            later = {e: softer(s) for e, s in now.items()}
            sharp = self.corners.get(x, 0.0)
            own = self.mask(x, now, sharp, near[x], centers)
            if rule(now, sharp) == rule(later, softer(sharp)):
                out[x] = own
                continue
            ending = [s for s in (*now.values(), sharp) if s > 0 and softer(s) == 0]
            weight = min(1.0, float(np.mean(ending)))
            out[x] = weight * own + (1 - weight) * self.mask(x, later, softer(sharp), near[x], centers)
        return out

    def mask(self, x, sharpness, sharp, near, centers):
        v, kind = self.vertices, rule(sharpness, sharp)
        if kind == "corner":
            return v[x]
        ends = np.array([v[next(y for y in e if y != x)] for e in sharpness])
        if kind == "crease":
            return 3 / 4 * v[x] + ends[[s > 0 for s in sharpness.values()]].sum(axis=0) / 8
        n = len(ends)
        if self.scheme == "loop":
            return (1 - n * beta(n)) * v[x] + beta(n) * ends.sum(axis=0)
        return (n - 2) / n * v[x] + (ends.sum(axis=0) + centers[near].sum(axis=0)) / n**2

    def limit(self):
        """Points (V, 3) on the limit surface; sharpness must be none or for ever, and faces quadrilaterals or Loop's.

        NaN where a crease ends: the mask of smooth vertices, which moves such a vertex, is not that of its limit.
        """
        v, around = self.vertices, self.edges()
        assert all(s >= INFINITE for s in (*self.creases.values(), *self.corners.values()))
        edges, opposite = [{} for _ in v], [[] for _ in v]
        for e in around:
            for x in e:
                edges[x][e] = self.creases.get(e, 0.0)
        for face in self.faces:
            for i, x in enumerate(face):
                opposite[x].append(face[(i + 2) % 4] if len(face) == 4 else x)
        out = v.copy()
        for x in range(len(v)):
            kind = rule(edges[x], self.corners.get(x, 0.0))
            if kind == "corner" or not edges[x]:
                continue
            ends = np.array([v[next(y for y in e if y != x)] for e in edges[x]])
            n = len(ends)
            if sum(s > 0 for s in edges[x].values()) == 1:
                out[x] = np.nan
            elif kind == "crease":
                out[x] = (4 * v[x] + ends[[s > 0 for s in edges[x].values()]].sum(axis=0)) / 6
            elif self.scheme == "loop":
                weight = 1 / (3 / (8 * beta(n)) + n)
                out[x] = (1 - n * weight) * v[x] + weight * ends.sum(axis=0)
            else:
                out[x] = (n * n * v[x] + 4 * ends.sum(axis=0) + v[opposite[x]].sum(axis=0)) / (n * (n + 5))
        return out

    def around(self, vertex, rings=6):
        """The faces in so many rings around a vertex, as a cage of their own; and the vertex's number there.

        A step of subdivision is wrong in one ring more: those near the vertex stay right if each is followed by this.
        """
        near = {vertex}
        for _ in range(rings):
            kept = [i for i, face in enumerate(self.faces) if near & set(face)]
            near = {v for i in kept for v in self.faces[i]}
        used = sorted(near)
        number, child = {v: i for i, v in enumerate(used)}, Cage.__new__(Cage)
        child.scheme, child.vertices = self.scheme, self.vertices[used]
        child.faces = [[number[v] for v in self.faces[i]] for i in kept]
        child.places = [self.places[i] for i in kept]
        child.creases = {frozenset(number[v] for v in e): s for e, s in self.creases.items() if e <= near}
        child.corners = {number[v]: s for v, s in self.corners.items() if v in near}
        return child, number[vertex]

    def samples(self, count):
        """Vertices below a number, faces (N,) and parameters (N, 2) of every corner at one of them."""
        rows = [
            (x, root, *at[j])
            for face, (root, at) in zip(self.faces, self.places, strict=True)
            for j, x in enumerate(face)
            if x < count
        ]
        vertex, root, u, v = np.array(rows).T
        return vertex.astype(int), root.astype(int), np.stack([u, v], axis=1)


def domain(scheme, corners):
    """Parameters of a face's corners (k, 2), as OpenSubdiv's Bfr has them."""
    if scheme == "loop":
        return np.array([(0.0, 0), (1, 0), (0, 1)])
    if corners == 4:
        return np.array([(0.0, 0), (1, 0), (1, 1), (0, 1)])
    wide = (2 if corners < 5 else 3) if corners < 10 else 1 + int(np.sqrt(corners - 1))
    return np.array([(i % wide, i // wide) for i in range(corners)], float)


def rule(sharpness, sharp):
    count = sum(s > 0 for s in sharpness.values())
    return "corner" if sharp > 0 or count > 2 else "crease" if count == 2 else "smooth"


def softer(sharp):
    return sharp if sharp >= INFINITE else max(sharp - 1, 0.0)


def beta(n):
    return (5 / 8 - (3 / 8 + np.cos(2 * np.pi / n) / 4) ** 2) / n


def limit_samples(vertices, faces, scheme, level=3, **tags):
    """Faces, parameters and limit points of all corners of faces after so many steps of subdivision."""
    cage = Cage(vertices, faces, scheme, **tags)
    for _ in range(level):
        cage = cage.refined()
    samples = cage.samples(len(cage.vertices))
    count = len(cage.vertices)
    # Vertices keep their numbers: sharpness may end later.
    while any(s < INFINITE for s in (*cage.creases.values(), *cage.corners.values())):
        cage = cage.refined()
    vertex, face, params = samples
    return face, params, cage.limit()[:count][vertex]
