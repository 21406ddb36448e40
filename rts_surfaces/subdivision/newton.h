// Where on a cage's surface rays meet it: Newton's method, across the edges of faces.

#pragma once

#include <algorithm>
#include <cmath>

#include "cage.h"

namespace {

constexpr double EDGE = 1e-7;  // What float32 parameters may be off anyway.

// A quadrilateral or triangular piece of a face: all of it, or a sub-face. Its coordinates x, y have the scale of the
// face's u, v; they reach from 0 to `size`.
struct Place {
    int face, part;
    double x, y, size;
};

double side_excess(Kind kind, Place const& p, int side) {
    if (kind == TRIANGLE) return side == 0 ? -p.y : side == 1 ? p.x + p.y - 1 : -p.x;
    return side == 0 ? -p.y : side == 1 ? p.x - p.size : side == 2 ? p.y - p.size : -p.x;
}

// How far a place is beyond its piece, and over which side.
double excess(Kind kind, Place const& p, int& side) {
    double most = -1e300;
    for (int s = 0; s < (kind == TRIANGLE ? 3 : 4); ++s) {
        double beyond = side_excess(kind, p, s);
        if (beyond > most) most = beyond, side = s;
    }
    return most;
}

Place place(Cage const& cage, int face, double const* uv) {
    if (cage.kinds[face] != SUBFACES) return {face, 0, uv[0], uv[1], 1.0};
    auto domain = cage.surfaces[0][face].GetParameterization();
    double origin[2];
    int part = std::min(std::max(domain.GetSubFace(uv), 0), cage.size(face) - 1);
    domain.GetVertexCoord(part, origin);
    return {face, part, uv[0] - origin[0], uv[1] - origin[1], 0.5};
}

void coordinates(Cage const& cage, Place const& p, double* uv) {
    double origin[2] = {0, 0};
    if (cage.kinds[p.face] == SUBFACES) cage.surfaces[0][p.face].GetParameterization().GetVertexCoord(p.part, origin);
    uv[0] = origin[0] + p.x;
    uv[1] = origin[1] + p.y;
}

// The piece beyond a side, and the same place in its coordinates; false where there is none.
bool cross(Cage const& cage, Place& p, int side) {
    Kind kind = Kind(cage.kinds[p.face]);
    int corners = cage.size(p.face), edge = side;
    double t = 0, d = side_excess(kind, p, side), weights[3] = {1 - p.x - p.y, p.x, p.y};
    if (kind == SUBFACES) {
        // Sides 1 and 2 end at the middle of the face, beside the next and the previous sub-face.
        if (side == 1) {
            p = {p.face, (p.part + 1) % corners, p.y, 1 - p.x, 0.5};
            return true;
        }
        if (side == 2) {
            p = {p.face, (p.part + corners - 1) % corners, 1 - p.y, p.x, 0.5};
            return true;
        }
        edge = side == 0 ? p.part : (p.part + corners - 1) % corners;
        t = side == 0 ? p.x : 1 - p.y;
    } else if (kind == QUAD) {
        t = side == 0 ? p.x : side == 1 ? p.y : side == 2 ? 1 - p.x : 1 - p.y;
    }
    int twin = cage.twins[cage.first[p.face] + edge];
    if (twin < 0) return false;
    int face = int(std::upper_bound(cage.first.begin(), cage.first.end(), twin) - cage.first.begin()) - 1;
    int j = twin - cage.first[face], other = cage.size(face);
    t = 1 - t;
    switch (Kind(cage.kinds[face])) {
        case NONE:
            return false;
        case TRIANGLE: {
            // The lattice of regular triangles goes on: the new corner is the sum of the edge's less the old one.
            double own[3];
            own[j] = weights[(side + 1) % 3] - d;
            own[(j + 1) % 3] = weights[side] - d;
            own[(j + 2) % 3] = d;
            p = {face, 0, own[1], own[2], 1.0};
            return true;
        }
        case QUAD:
            p = j == 0   ? Place{face, 0, t, d, 1.0}
                : j == 1 ? Place{face, 0, 1 - d, t, 1.0}
                : j == 2 ? Place{face, 0, 1 - t, 1 - d, 1.0}
                         : Place{face, 0, d, 1 - t, 1.0};
            return true;
        default:
            p = t <= 0.5 ? Place{face, j, t, d, 0.5} : Place{face, (j + 1) % other, d, 1 - t, 0.5};
            return true;
    }
}

// Two directions across a ray, which is not zero.
void across(double const* ray, double* p, double* q) {
    int k = 0;
    if (std::abs(ray[1]) < std::abs(ray[k])) k = 1;
    if (std::abs(ray[2]) < std::abs(ray[k])) k = 2;
    int i = (k + 1) % 3, j = (k + 2) % 3;
    double length = std::hypot(ray[i], ray[j]), root = std::hypot(ray[0], ray[1], ray[2]);
    p[k] = 0, p[i] = -ray[j] / length, p[j] = ray[i] / length;
    for (int c = 0; c < 3; ++c)
        q[c] = (ray[(c + 1) % 3] * p[(c + 2) % 3] - ray[(c + 2) % 3] * p[(c + 1) % 3]) / root;
}

// Newton's method along one ray from a place on the surface; whether it met, where, and at what depth.
bool meet(Points const& points, Place& at, double const* origin, double const* ray, double const* spread,
          double const* limits, double& depth) {
    Cage const& cage = *points.cage;
    int const steps = int(limits[1]), crossings = int(limits[4]);
    double p[3], q[3], found[9], uv[2];
    double const square = ray[0] * ray[0] + ray[1] * ray[1] + ray[2] * ray[2];
    across(ray, p, q);
    for (int step = 0, crossed = 0, side = 0; step <= steps; ++step) {
        coordinates(cage, at, uv);
        points.evaluate(at.face, uv, found, 1);
        double f = 0, g = 0, z = 0, fu = 0, fv = 0, gu = 0, gv = 0;
        for (int c = 0; c < 3; ++c) {
            double off = found[c] - origin[c];
            f += p[c] * off, g += q[c] * off, z += ray[c] * off;
            fu += p[c] * found[3 + c], fv += p[c] * found[6 + c];
            gu += q[c] * found[3 + c], gv += q[c] * found[6 + c];
        }
        z /= square;
        depth = z;
        double width = std::abs(spread[0] + spread[1] * z);
        if (f * f + g * g <= limits[0] * limits[0] * width * width)
            return excess(Kind(cage.kinds[at.face]), at, side) <= limits[3] * at.size;
        double determinant = fu * gv - fv * gu, scale = (fu * fu + gu * gu) * (fv * fv + gv * gv);
        if (!(determinant * determinant > 1e-24 * scale)) return false;
        double du = (fv * g - gv * f) / determinant, dv = (gu * f - fu * g) / determinant;
        if (!std::isfinite(du) || !std::isfinite(dv)) return false;
        double size = std::max(std::abs(du), std::abs(dv)), largest = limits[2] * at.size;
        if (size > largest) du *= largest / size, dv *= largest / size;
        double const low = -0.25 * at.size, high = 1.25 * at.size;
        at.x = std::min(std::max(at.x + du, low), high);
        at.y = std::min(std::max(at.y + dv, low), high);
        // What lies beyond an edge is not extrapolated: patches about extraordinary vertices are much smaller than faces.
        if (crossed < crossings && excess(Kind(cage.kinds[at.face]), at, side) > EDGE) crossed += cross(cage, at, side);
    }
    return false;
}

}  // namespace
