// Optimised local-global steps: x, y, z of a vertex are contiguous, one loop over the springs scatters to both ends,
// and an iteration allocates nothing. Q = L D L' by CHOLMOD (AMD or METIS, whichever has less fill-in; Chen, Davis,
// Hager, Rajamanickam 2008); a solve passes over its columns once for all three coordinates.

#include <cholmod.h>

#include <cmath>
#include <cstdint>
#include <vector>

struct Steps {
    cholmod_common c;
    cholmod_factor* L = nullptr;
    std::int64_t n, f;
    std::vector<int> i, j, at;  // the springs' ends; at: the vertex of each row of L
    std::vector<double> k, r, b, x;

    void local(const double* p, const double* y, double* out) const {
        for (std::int64_t v = 0; v < 3 * n; ++v) out[v] = y[v];
        for (std::size_t e = 0; e < k.size(); ++e) {
            const double *a = p + 3 * i[e], *q = p + 3 * j[e];
            const double dx = a[0] - q[0], dy = a[1] - q[1], dz = a[2] - q[2];
            const double length = std::sqrt(dx * dx + dy * dy + dz * dz);
            const double s = length > 0.0 ? k[e] * r[e] / length : 0.0;
            double *u = out + 3 * i[e], *w = out + 3 * j[e];
            u[0] += s * dx, u[1] += s * dy, u[2] += s * dz;
            w[0] -= s * dx, w[1] -= s * dy, w[2] -= s * dz;
        }
    }

    // x = (L D L')^-1 x, with rows in the order of L.
    void solve() {
        const int *start = static_cast<int*>(L->p), *row = static_cast<int*>(L->i), *nz = static_cast<int*>(L->nz);
        const double* value = static_cast<double*>(L->x);
        for (std::int64_t c = 0; c < f; ++c) {
            const double x0 = x[3 * c], x1 = x[3 * c + 1], x2 = x[3 * c + 2];
            for (int e = start[c] + 1; e < start[c] + nz[c]; ++e) {
                double* to = &x[3 * row[e]];
                to[0] -= value[e] * x0, to[1] -= value[e] * x1, to[2] -= value[e] * x2;
            }
        }
        for (std::int64_t c = f - 1; c >= 0; --c) {
            const double d = 1.0 / value[start[c]];
            double x0 = d * x[3 * c], x1 = d * x[3 * c + 1], x2 = d * x[3 * c + 2];
            for (int e = start[c] + 1; e < start[c] + nz[c]; ++e) {
                const double* from = &x[3 * row[e]];
                x0 -= value[e] * from[0], x1 -= value[e] * from[1], x2 -= value[e] * from[2];
            }
            x[3 * c] = x0, x[3 * c + 1] = x1, x[3 * c + 2] = x2;
        }
    }
};

extern "C" {

// edges: (m, 2); free: the f vertices without exact pins; pinned, w: the q penalty pins; inertia: M/dt^2.
// Returns null if Q has no factor.
Steps* prepare(std::int64_t n, std::int64_t m, std::int64_t q, std::int64_t f, const std::int64_t* edges,
               const std::int64_t* pinned, const std::int64_t* free, const double* k, const double* rest,
               const double* inertia, const double* w) {
    auto* made = new Steps;
    made->n = n, made->f = f;
    made->k.assign(k, k + m), made->r.assign(rest, rest + m), made->b.resize(3 * n), made->x.resize(3 * f);
    std::vector<double> diagonal(inertia, inertia + n);
    for (std::int64_t pin = 0; pin < q; ++pin) diagonal[pinned[pin]] += w[pin];
    std::vector<int> row(n, -1);
    for (std::int64_t v = 0; v < f; ++v) row[free[v]] = v;

    cholmod_common* c = &made->c;
    cholmod_start(c);
    c->supernodal = CHOLMOD_SIMPLICIAL;
    c->final_ll = 0;
    c->print = 0;
    cholmod_triplet* entries = cholmod_allocate_triplet(f, f, m + f, -1, CHOLMOD_REAL, c);
    auto add = [&](int at, int other, double value) {
        static_cast<int*>(entries->i)[entries->nnz] = at > other ? at : other;
        static_cast<int*>(entries->j)[entries->nnz] = at > other ? other : at;
        static_cast<double*>(entries->x)[entries->nnz++] = value;
    };
    for (std::int64_t e = 0; e < m; ++e) {
        const int a = edges[2 * e], z = edges[2 * e + 1];
        made->i.push_back(a), made->j.push_back(z);
        diagonal[a] += k[e], diagonal[z] += k[e];
        if (row[a] >= 0 && row[z] >= 0 && a != z) add(row[a], row[z], -k[e]);
    }
    for (std::int64_t v = 0; v < f; ++v) add(v, v, diagonal[free[v]]);
    cholmod_sparse* Q = cholmod_triplet_to_sparse(entries, entries->nnz, c);
    made->L = cholmod_analyze(Q, c);
    cholmod_factorize(Q, made->L, c);
    bool good = c->status == CHOLMOD_OK && made->L->minor == static_cast<std::size_t>(f);
    for (std::int64_t v = 0; good && v < f; ++v)  // L D L' of an indefinite Q exists too
        good = static_cast<double*>(made->L->x)[static_cast<int*>(made->L->p)[v]] > 0.0;
    cholmod_free_sparse(&Q, c);
    cholmod_free_triplet(&entries, c);
    for (std::int64_t v = 0; v < f; ++v) made->at.push_back(free[static_cast<int*>(made->L->Perm)[v]]);
    if (good) return made;
    cholmod_free_factor(&made->L, c);
    cholmod_finish(c);
    delete made;
    return nullptr;
}

void local(const Steps* made, std::int64_t, const double* p, const double* y, double* b) { made->local(p, y, b); }

// Solves for the free rows only.
void global_(Steps* made, std::int64_t f, const double* b, double* p) {
    const int* order = static_cast<int*>(made->L->Perm);
    for (std::int64_t v = 0; v < f; ++v)
        for (int d = 0; d < 3; ++d) made->x[3 * v + d] = b[3 * order[v] + d];
    made->solve();
    for (std::int64_t v = 0; v < f; ++v)
        for (int d = 0; d < 3; ++d) p[3 * order[v] + d] = made->x[3 * v + d];
}

void iterate(Steps* made, std::int64_t count, double* p, const double* y) {
    for (; count > 0; --count) {
        made->local(p, y, made->b.data());
        for (std::int64_t v = 0; v < made->f; ++v)
            for (int d = 0; d < 3; ++d) made->x[3 * v + d] = made->b[3 * made->at[v] + d];
        made->solve();
        for (std::int64_t v = 0; v < made->f; ++v)
            for (int d = 0; d < 3; ++d) p[3 * made->at[v] + d] = made->x[3 * v + d];
    }
}

void release(Steps* made) {
    cholmod_free_factor(&made->L, &made->c);
    cholmod_finish(&made->c);
    delete made;
}
}
