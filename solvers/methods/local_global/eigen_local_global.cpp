// C interface for `solvers.methods.local_global.eigen_local_global`. Points are stored as x, y, z per vertex.

#include "eigen_local_global.hpp"

using Rows = Eigen::Matrix<double, Eigen::Dynamic, 3, Eigen::RowMajor>;
using In = Eigen::Map<const Rows>;
using Out = Eigen::Map<Rows>;

extern "C" {

// Returns null if Q has no factor.
LocalGlobal* prepare(std::int64_t n, std::int64_t m, std::int64_t q, std::int64_t f, const std::int64_t* edges,
                     const std::int64_t* pinned, const std::int64_t* free, const double* k, const double* rest,
                     const double* mass_over_dt2, const double* w) {
    auto* made = new LocalGlobal(n, m, q, f, edges, pinned, free, k, rest, mass_over_dt2, w);
    if (made->factorised()) return made;
    delete made;
    return nullptr;
}

void local(const LocalGlobal* made, std::int64_t n, const double* p, const double* y, double* b) {
    Out(b, n, 3) = made->local(In(p, n, 3), In(y, n, 3));
}

void global_(const LocalGlobal* made, std::int64_t f, const double* b, double* p) {
    Out(p, f, 3) = made->global(In(b, f, 3));
}

void release(LocalGlobal* made) { delete made; }
}
