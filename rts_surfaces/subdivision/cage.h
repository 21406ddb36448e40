// A cage with the limit surface of each of its faces, and the points of these for given vertices.

#pragma once

#include <algorithm>
#include <cmath>
#include <memory>
#include <stdexcept>
#include <vector>

#include <opensubdiv/bfr/surface.h>

using Surface = OpenSubdiv::Bfr::Surface<double>;

enum Kind { NONE = -1, QUAD, TRIANGLE, SUBFACES };  // Of faces; the values of Bfr's Parameterization.

// Half edge h = first[f] + i runs from corner i of face f to the next.
struct Cage {
    std::vector<Surface> surfaces[2];  // Of vertex data, and of face-varying data. Invalid where a face has no limit.
    int width[2] = {0, 0};             // The largest number of control points of a face.
    std::vector<int> first;            // (F + 1,), the first half edge of each face.
    std::vector<int> twins;            // (H,), the half edge that runs the other way, or -1.
    std::vector<int> kinds;            // (F,)

    int size(int face) const { return first[face + 1] - first[face]; }

    // Refuse parameters that lie far outside a face: Bfr would look for patches that there are not.
    void check(int face, double const* uv) const {
        Surface const& surface = surfaces[0][face];
        if (!surface.IsValid()) return;
        auto domain = surface.GetParameterization();
        double origin[2] = {0, 0};
        bool inside = std::max(std::abs(uv[0]), std::abs(uv[1])) < 1000;
        if (inside && domain.HasSubFaces()) {
            int part = domain.GetSubFace(uv);
            inside = 0 <= part && part < size(face);
            if (inside) domain.GetVertexCoord(part, origin);
        }
        double least = std::min(uv[0] - origin[0], uv[1] - origin[1]);
        double most = std::max(uv[0] - origin[0], uv[1] - origin[1]);
        if (!inside || !(least >= -0.3 && most <= 1.3)) throw std::out_of_range("parameters lie far outside their face");
    }
};

// Control points of every face, and the further points that its patches have, for given vertices.
struct Points {
    Cage const* cage;
    std::vector<size_t> first;
    std::unique_ptr<double[]> rows;  // Not a vector, which would be filled with zeros first.

    void evaluate(int face, double const* uv, double* out, int derivatives) const {
        double const* own = rows.get() + 3 * first[face];
        Surface const& surface = cage->surfaces[0][face];
        if (!surface.IsValid())
            std::fill(out, out + 3 * (derivatives == 2 ? 6 : derivatives == 1 ? 3 : 1), 0.0);
        else if (derivatives == 2)
            surface.Evaluate(uv, own, 3, out, out + 3, out + 6, out + 9, out + 12, out + 15);
        else if (derivatives == 1)
            surface.Evaluate(uv, own, 3, out, out + 3, out + 6);
        else
            surface.Evaluate(uv, own, 3, out);
    }
};
