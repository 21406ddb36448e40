// Limit surfaces of subdivision by OpenSubdiv's Bfr, behind a C interface that Python's ctypes can call.
//
// Nothing is thrown across it: each function gives 0, or 1 and a text for its thread. Cages are checked before they come
// here. Once made, a cage and its points are only read, so that any number of threads may call with ranges of their own.

#include <algorithm>
#include <exception>
#include <memory>
#include <stdexcept>
#include <string>
#include <vector>

#include <opensubdiv/bfr/refinerSurfaceFactory.h>
#include <opensubdiv/far/error.h>
#include <opensubdiv/far/topologyDescriptor.h>
#include <opensubdiv/far/topologyRefiner.h>

#include "cage.h"
#include "newton.h"

using namespace OpenSubdiv;
using Factory = Bfr::RefinerSurfaceFactory<>;

namespace {

thread_local std::string message;

void note(char const* text) {
    if (!message.empty()) message += "; ";
    message += text;
}
void note_error(Far::ErrorType, char const* text) { note(text); }

template <class Body>
int guarded(Body body) {
    message.clear();
    try {
        body();
    } catch (std::exception const& error) {
        note(error.what());
        return 1;
    } catch (...) {
        note("an unknown exception");
        return 1;
    }
    return 0;
}

}  // namespace

// What the caller lends while a cage is made.
struct Description {
    int scheme, boundary, chaikin, uv_rule;  // Values of the Sdc enumerations; chaikin 0 or 1.
    int smooth, sharp;                       // Levels to which features are isolated.
    int vertices, faces;
    int const *sizes, *indices, *twins;  // (F,), (H,), and (H,) the half edge that runs the other way, or -1.
    int creases, corners;
    int const* crease_pairs;  // (creases, 2)
    float const* crease_sharpness;
    int const* corner_vertices;
    float const* corner_sharpness;
    int holes;
    int const* hole_faces;
    int uv_rows;            // 0 where there is no face-varying data.
    int const* uv_indices;  // (H,)
};

namespace {

void build(Cage& cage, Description const& d) {
    Far::TopologyDescriptor topology;
    topology.numVertices = d.vertices;
    topology.numFaces = d.faces;
    topology.numVertsPerFace = d.sizes;
    topology.vertIndicesPerFace = d.indices;
    topology.numCreases = d.creases;
    topology.creaseVertexIndexPairs = d.crease_pairs;
    topology.creaseWeights = d.crease_sharpness;
    topology.numCorners = d.corners;
    topology.cornerVertexIndices = d.corner_vertices;
    topology.cornerWeights = d.corner_sharpness;
    topology.numHoles = d.holes;
    topology.holeIndices = d.hole_faces;
    Far::TopologyDescriptor::FVarChannel channel;
    channel.numValues = d.uv_rows;
    channel.valueIndices = d.uv_indices;
    topology.numFVarChannels = d.uv_rows > 0;
    topology.fvarChannels = &channel;

    Sdc::Options options;
    options.SetVtxBoundaryInterpolation(Sdc::Options::VtxBoundaryInterpolation(d.boundary));
    options.SetFVarLinearInterpolation(Sdc::Options::FVarLinearInterpolation(d.uv_rule));
    options.SetCreasingMethod(d.chaikin ? Sdc::Options::CREASE_CHAIKIN : Sdc::Options::CREASE_UNIFORM);
    using Refiners = Far::TopologyRefinerFactory<Far::TopologyDescriptor>;
    std::unique_ptr<Far::TopologyRefiner> refiner(
        Refiners::Create(topology, Refiners::Options(Sdc::SchemeType(d.scheme), options)));
    if (!refiner || !message.empty()) throw std::runtime_error("OpenSubdiv refuses the cage");

    Factory::Options levels;
    levels.SetApproxLevelSmooth(d.smooth);
    levels.SetApproxLevelSharp(d.sharp);
    Factory factory(*refiner, levels);
    cage.first.push_back(0);
    for (int f = 0; f < d.faces; ++f) cage.first.push_back(cage.first.back() + d.sizes[f]);
    cage.twins.assign(d.twins, d.twins + cage.first.back());
    cage.kinds.assign(d.faces, NONE);
    for (int channel = 0; channel < (d.uv_rows > 0 ? 2 : 1); ++channel) {
        auto& surfaces = cage.surfaces[channel];
        surfaces.resize(d.faces);
        for (int f = 0; f < d.faces; ++f) {
            bool made = channel ? factory.InitFaceVaryingSurface(f, &surfaces[f], 0)
                                : factory.InitVertexSurface(f, &surfaces[f]);
            if (!made) continue;  // A hole, or a face on a boundary that is not interpolated.
            cage.width[channel] = std::max(cage.width[channel], surfaces[f].GetNumControlPoints());
            if (!channel) cage.kinds[f] = surfaces[f].GetParameterization().GetType();
        }
    }
    if (!message.empty()) throw std::runtime_error("OpenSubdiv refuses the cage");
}

// Whether two rows of numbers are parallel, or one is zero.
bool parallel(double const* a, double const* b, int count) {
    double aa = 0, ab = 0, bb = 0;
    for (int i = 0; i < count; ++i) aa += a[i] * a[i], ab += a[i] * b[i], bb += b[i] * b[i];
    return aa * bb - ab * ab <= 1e-10 * aa * bb;
}

// Weights of control points, in rows of the width of the table, filled up with zeros.
template <class Real>
void stencils(Cage const& cage, int channel, long start, long stop, int const* faces, double const* params, Real* point,
              Real* along_u, Real* along_v) {
    int const width = cage.width[channel];
    std::vector<double> scratch(3 * size_t(width));
    double *p = scratch.data(), *du = p + width, *dv = du + width;
    auto put = [width](double const* from, int count, Real* to) {
        for (int i = 0; i < count; ++i) to[i] = Real(from[i]);
        std::fill(to + count, to + width, Real(0));
    };
    for (long n = start; n < stop; ++n) {
        Surface const& surface = cage.surfaces[channel][faces[n]];
        double const* uv = params + 2 * n;
        if (n > start && faces[n] == faces[n - 1] && uv[0] == uv[-2] && uv[1] == uv[-1]) {
            // Rows that are allotted but not used are all alike.
            for (Real* rows : {point, along_u, along_v})
                if (rows) std::copy(rows + (n - 1) * width, rows + n * width, rows + n * width);
            continue;
        }
        cage.check(faces[n], uv);
        int count = 0;
        if (surface.IsValid() && along_u) {
            count = surface.EvaluateStencil(uv, p, du, dv);
            if (parallel(du, dv, count)) {
                // As at the corner of a sheet whose boundary is smooth: the tangent plane is that of a point beside it.
                auto domain = surface.GetParameterization();
                double center[2], origin[2] = {0, 0};
                if (domain.HasSubFaces()) {
                    domain.GetVertexCoord(domain.GetSubFace(uv), origin);
                    center[0] = origin[0] + 0.25, center[1] = origin[1] + 0.25;
                } else {
                    domain.GetCenterCoord(center);
                }
                double beside[2] = {uv[0] + 1e-3 * (center[0] - uv[0]), uv[1] + 1e-3 * (center[1] - uv[1])};
                std::vector<double> unused(width);
                surface.EvaluateStencil(beside, unused.data(), du, dv);
            }
        } else if (surface.IsValid()) {
            count = surface.EvaluateStencil(uv, p);
        }
        if (point) put(p, count, point + n * width);
        if (along_u) put(du, count, along_u + n * width), put(dv, count, along_v + n * width);
    }
}

}  // namespace

extern "C" {

char const* rts_message() { return message.c_str(); }

// Messages of OpenSubdiv, which it prints otherwise. To be called once.
void rts_start() {
    Far::SetErrorCallback(note_error);
    Far::SetWarningCallback(note);
}

int rts_cage(Description const* description, Cage** made, int* widths) {
    return guarded([&] {
        auto cage = std::make_unique<Cage>();
        build(*cage, *description);
        std::copy(cage->width, cage->width + 2, widths);
        *made = cage.release();
    });
}

void rts_cage_free(Cage* cage) { delete cage; }

// The control points of each face (F, width), rows filled up with their first number; its kind (F,); and where in its
// parameters its corners are (H, 2).
int rts_tables(Cage const* cage, int* vertex, int* uv, int* kinds, double* corners) {
    return guarded([&] {
        for (int channel = 0; channel < 2; ++channel) {
            int* rows = channel ? uv : vertex;
            int const width = cage->width[channel];
            for (size_t f = 0; rows && f < cage->kinds.size(); ++f, rows += width) {
                Surface const& surface = cage->surfaces[channel][f];
                int count = surface.IsValid() ? surface.GetControlPointIndices(rows) : 0;
                std::fill(rows + count, rows + width, count ? rows[0] : 0);
            }
        }
        std::copy(cage->kinds.begin(), cage->kinds.end(), kinds);
        for (size_t f = 0; f < cage->kinds.size(); ++f)
            for (int i = 0; i < cage->size(int(f)); ++i, corners += 2) {
                corners[0] = corners[1] = 0;
                if (cage->kinds[f] != NONE) cage->surfaces[0][f].GetParameterization().GetVertexCoord(i, corners);
            }
    });
}

int rts_stencils_float(Cage const* cage, int channel, long start, long stop, int const* faces, double const* params,
                       float* point, float* along_u, float* along_v) {
    return guarded([&] { stencils(*cage, channel, start, stop, faces, params, point, along_u, along_v); });
}

int rts_stencils_double(Cage const* cage, int channel, long start, long stop, int const* faces, double const* params,
                        double* point, double* along_u, double* along_v) {
    return guarded([&] { stencils(*cage, channel, start, stop, faces, params, point, along_u, along_v); });
}

// The cage must outlive its points.
int rts_points(Cage const* cage, Points** made) {
    return guarded([&] {
        auto points = std::make_unique<Points>();
        points->cage = cage;
        points->first.push_back(0);
        for (Surface const& surface : cage->surfaces[0])
            points->first.push_back(points->first.back() + (surface.IsValid() ? surface.GetNumPatchPoints() : 0));
        points->rows.reset(new double[3 * points->first.back()]);
        *made = points.release();
    });
}

void rts_points_free(Points* points) { delete points; }

// Fill the points of a range of faces, for vertices (V, 3).
int rts_move(Points* points, long start, long stop, double const* vertices) {
    return guarded([&] {
        for (long f = start; f < stop; ++f) {
            Surface const& surface = points->cage->surfaces[0][f];
            if (surface.IsValid())
                surface.PreparePatchPoints(vertices, 3, points->rows.get() + 3 * points->first[f], 3);
        }
    });
}

// Fill `out` (N, 1, 3, or 6, 3): points, along u and v, and along uu, uv and vv.
int rts_evaluate(Points const* points, long start, long stop, int const* faces, double const* params, int derivatives,
                 double* out) {
    return guarded([&] {
        int const width = 3 * (derivatives == 2 ? 6 : derivatives == 1 ? 3 : 1);
        for (long n = start; n < stop; ++n) {
            points->cage->check(faces[n], params + 2 * n);
            points->evaluate(faces[n], params + 2 * n, out + n * width, derivatives);
        }
    });
}

// Move samples, their faces (N,) and params (N, 2), along rays; fill their depths (N,) and whether they met (N,).
// Limits (5,): residual in pixels, steps, the largest step, how far beyond an edge, how many edges may be crossed.
int rts_newton(Points const* points, long start, long stop, int* faces, double* params, double const* origins,
               double const* directions, double const* spread, double const* limits, double* depth, bool* met) {
    return guarded([&] {
        Cage const& cage = *points->cage;
        for (long n = start; n < stop; ++n) {
            met[n] = false, depth[n] = 0;
            if (cage.kinds[faces[n]] == NONE) continue;
            cage.check(faces[n], params + 2 * n);
            Place at = place(cage, faces[n], params + 2 * n);
            met[n] = meet(*points, at, origins + 3 * n, directions + 3 * n, spread, limits, depth[n]);
            if (!met[n]) continue;
            faces[n] = at.face;
            coordinates(cage, at, params + 2 * n);
        }
    });
}

}  // extern "C"
