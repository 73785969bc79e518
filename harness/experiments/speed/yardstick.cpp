// The yardstick: local-global steps as a course's assignment has them written, with Eigen's SimplicialLLT.
//
//     y = M target/dt^2 + f + w C'p_pin        once a step
//     local step   d_e = r_e (A p)_e / |(A p)_e|
//     global step  Q p = A'K d + y             Q = A'K A + M/dt^2 + w C'C, factorised once
//
// Plain code on purpose: Eigen's matrices of doubles, column by column as they come (p is n x 3), products of sparse
// matrices, one loop over the springs. The scene comes from the file named first (see `harness.speed.yardstick`).
// It answers with the seconds of its preparation. Each line of the input is a number of iterations: a step from the
// first guess, answered by seconds of wall time: of the step, of its local steps, of its global steps. The end of
// the input writes the last positions, row by row, to the file named second.

#include <Eigen/Sparse>

#include <chrono>
#include <cstdint>
#include <cstdio>
#include <fstream>
#include <iostream>
#include <vector>

using Eigen::MatrixXd;
using Eigen::VectorXd;
using Sparse = Eigen::SparseMatrix<double>;
using Triplet = Eigen::Triplet<double>;
using Clock = std::chrono::steady_clock;

static std::ifstream scene;

template <typename T>
static std::vector<T> read(std::size_t count) {
    std::vector<T> values(count);
    scene.read(reinterpret_cast<char*>(values.data()), static_cast<std::streamsize>(count * sizeof(T)));
    return values;
}

static VectorXd vector(std::size_t count) {
    const std::vector<double> values = read<double>(count);
    return Eigen::Map<const VectorXd>(values.data(), static_cast<Eigen::Index>(count));
}

// Points lie in the file as x, y, z of one vertex after the other.
static MatrixXd points(std::size_t count) {
    const std::vector<double> values = read<double>(3 * count);
    using Rows = Eigen::Matrix<double, Eigen::Dynamic, 3, Eigen::RowMajor>;
    return Eigen::Map<const Rows>(values.data(), static_cast<Eigen::Index>(count), 3);
}

static Sparse matrix(std::size_t rows, std::size_t columns, const std::vector<Triplet>& entries) {
    Sparse built(static_cast<Eigen::Index>(rows), static_cast<Eigen::Index>(columns));
    built.setFromTriplets(entries.begin(), entries.end());
    return built;
}

static double since(Clock::time_point began) {
    return std::chrono::duration<double>(Clock::now() - began).count();
}

int main(int count, char** arguments) {
    if (count != 3) return 2;
    scene.open(arguments[1], std::ios::binary);
    const std::vector<std::int64_t> sizes = read<std::int64_t>(3);
    const std::size_t n = sizes[0], m = sizes[1], q = sizes[2];
    const double dt = read<double>(1)[0];
    const std::vector<std::int64_t> edges = read<std::int64_t>(2 * m), pinned = read<std::int64_t>(q);
    const VectorXd k = vector(m), r = vector(m), mass = vector(n), w = vector(q);
    const MatrixXd target = points(n), force = points(n), first_guess = points(n), pins = points(q);
    if (!scene) return 3;

    const Clock::time_point began = Clock::now();
    std::vector<Triplet> a, c, diagonal;
    for (std::size_t e = 0; e < m; ++e) {
        a.emplace_back(e, edges[2 * e], 1.0);
        a.emplace_back(e, edges[2 * e + 1], -1.0);
    }
    for (std::size_t i = 0; i < q; ++i) c.emplace_back(i, pinned[i], 1.0);
    for (std::size_t i = 0; i < n; ++i) diagonal.emplace_back(i, i, mass[i] / (dt * dt));
    const Sparse A = matrix(m, n, a), C = matrix(q, n, c), M = matrix(n, n, diagonal);
    const Sparse AtK = A.transpose() * k.asDiagonal();
    const Sparse CtW = C.transpose() * w.asDiagonal();
    const Sparse Q = AtK * A + M + CtW * C;
    const Eigen::SimplicialLLT<Sparse> solver(Q);
    if (solver.info() != Eigen::Success) return 4;
    std::printf("%.9g\n", since(began));
    std::fflush(stdout);

    MatrixXd p = first_guess;
    for (int iterations; std::cin >> iterations;) {
        const Clock::time_point start = Clock::now();
        p = first_guess;
        const MatrixXd y = M * target + force + CtW * pins;
        double local = 0.0, global = 0.0;
        for (int iteration = 0; iteration < iterations; ++iteration) {
            const Clock::time_point before = Clock::now();
            MatrixXd d = A * p;
            for (std::size_t e = 0; e < m; ++e) d.row(e) = r[e] * d.row(e).normalized();
            const MatrixXd b = AtK * d + y;
            const Clock::time_point between = Clock::now();
            p = solver.solve(b);
            local += std::chrono::duration<double>(between - before).count();
            global += since(between);
        }
        std::printf("%.9g %.9g %.9g\n", since(start), local, global);
        std::fflush(stdout);
    }
    std::ofstream last(arguments[2], std::ios::binary);
    for (std::size_t i = 0; i < n; ++i)
        for (int x = 0; x < 3; ++x) last.write(reinterpret_cast<const char*>(&p(i, x)), sizeof(double));
    return last ? 0 : 5;
}
