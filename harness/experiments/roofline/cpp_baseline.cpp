// C++ baseline: one step of the local-global iterations of `eigen_local_global.hpp`, timed repeatedly.
//
// Input: the scene, from the file named first (see `harness.experiments.roofline.cpp_baseline`); then, on the standard
// input, a number of iterations per line. Output: the seconds of the preparation; then, for each line, the wall seconds
// of a step from the initial guess, of its local steps and of its global steps. At the end of the input the last
// positions are written, row by row, to the file named second.

#include "eigen_local_global.hpp"

#include <chrono>
#include <cstdio>
#include <fstream>
#include <iostream>

using Clock = std::chrono::steady_clock;

static std::ifstream scene;

template <typename T>
static std::vector<T> read(std::size_t count) {
    std::vector<T> values(count);
    scene.read(reinterpret_cast<char*>(values.data()), static_cast<std::streamsize>(count * sizeof(T)));
    return values;
}

// Points are stored as x, y, z of one vertex after the other.
static MatrixXd points(std::size_t count) {
    const std::vector<double> values = read<double>(3 * count);
    using Rows = Eigen::Matrix<double, Eigen::Dynamic, 3, Eigen::RowMajor>;
    return Eigen::Map<const Rows>(values.data(), static_cast<Eigen::Index>(count), 3);
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
    const std::vector<double> k = read<double>(m), r = read<double>(m), mass = read<double>(n), w = read<double>(q);
    const MatrixXd target = points(n), force = points(n), first_guess = points(n), pins = points(q);
    if (!scene) return 3;

    const Clock::time_point began = Clock::now();
    std::vector<double> inertia(n);
    for (std::size_t i = 0; i < n; ++i) inertia[i] = mass[i] / (dt * dt);
    const LocalGlobal steps(n, m, q, n, edges.data(), pinned.data(), nullptr, k.data(), r.data(), inertia.data(),
                            w.data());
    if (!steps.factorised()) return 4;
    std::printf("%.9g\n", since(began));
    std::fflush(stdout);

    MatrixXd p = first_guess;
    for (int iterations; std::cin >> iterations;) {
        const Clock::time_point start = Clock::now();
        p = first_guess;
        const MatrixXd y = steps.constant(target, force, pins);
        double local = 0.0, global = 0.0;
        for (int iteration = 0; iteration < iterations; ++iteration) {
            const Clock::time_point before = Clock::now();
            const MatrixXd b = steps.local(p, y);
            const Clock::time_point between = Clock::now();
            p = steps.global(b);
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
