// Local-global steps as in a course assignment, with Eigen's SimplicialLLT.
//
//     y = M target/dt^2 + f + w C'p_pin        once a step
//     local step   d_e = r_e (A p)_e / |(A p)_e|
//     global step  Q p = A'K d + y             Q = A'K A + M/dt^2 + w C'C, factorised once
//
// Deliberately plain: Eigen matrices of doubles in their default column-major order (p is n x 3), sparse matrix
// products, one loop over the springs.

#pragma once

#include <Eigen/Sparse>

#include <cstdint>
#include <vector>

using Eigen::MatrixXd;
using Eigen::VectorXd;
using Sparse = Eigen::SparseMatrix<double>;
using Triplet = Eigen::Triplet<double>;

inline Sparse matrix(std::int64_t rows, std::int64_t columns, const std::vector<Triplet>& entries) {
    Sparse built(rows, columns);
    built.setFromTriplets(entries.begin(), entries.end());
    return built;
}

// Selection matrix for some of n rows.
inline Sparse selection(const std::int64_t* rows, std::int64_t count, std::int64_t n) {
    std::vector<Triplet> entries;
    for (std::int64_t i = 0; i < count; ++i) entries.emplace_back(i, rows[i], 1.0);
    return matrix(count, n, entries);
}

class LocalGlobal {
public:
    // edges: (m, 2); free: the f vertices without exact pins; pinned, w: the q penalty pins.
    LocalGlobal(std::int64_t n, std::int64_t m, std::int64_t q, std::int64_t f, const std::int64_t* edges,
                const std::int64_t* pinned, const std::int64_t* free, const double* k, const double* rest,
                const double* mass_over_dt2, const double* w)
        : r(Eigen::Map<const VectorXd>(rest, m)) {
        std::vector<Triplet> a, diagonal;
        for (std::int64_t e = 0; e < m; ++e) {
            a.emplace_back(e, edges[2 * e], 1.0);
            a.emplace_back(e, edges[2 * e + 1], -1.0);
        }
        for (std::int64_t i = 0; i < n; ++i) diagonal.emplace_back(i, i, mass_over_dt2[i]);
        A = matrix(m, n, a);
        M = matrix(n, n, diagonal);
        const Sparse C = selection(pinned, q, n);
        AtK = A.transpose() * Eigen::Map<const VectorXd>(k, m).asDiagonal();
        CtW = C.transpose() * Eigen::Map<const VectorXd>(w, q).asDiagonal();
        Sparse Q = AtK * A + M + CtW * C;
        if (f < n) {
            const Sparse S = selection(free, f, n);
            Q = Sparse(S * Q) * S.transpose();
        }
        solver.compute(Q);
    }

    bool factorised() const { return solver.info() == Eigen::Success; }

    MatrixXd constant(const MatrixXd& target, const MatrixXd& force, const MatrixXd& pins) const {
        return M * target + force + CtW * pins;
    }

    MatrixXd local(const MatrixXd& p, const MatrixXd& y) const {
        MatrixXd d = A * p;
        for (Eigen::Index e = 0; e < d.rows(); ++e) d.row(e) = r[e] * d.row(e).normalized();
        return AtK * d + y;
    }

    MatrixXd global(const MatrixXd& b) const { return solver.solve(b); }

private:
    VectorXd r;
    Sparse A, M, AtK, CtW;
    Eigen::SimplicialLLT<Sparse> solver;
};
