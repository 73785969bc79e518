// Optimised local-global steps. Vertices are in the order of the factor, with x, y, z and a zero in one vector register.
// One loop over the springs scatters to both ends; an iteration allocates and permutes nothing. Q = L D L' by CHOLMOD
// (AMD or METIS, whichever has less fill-in; Chen, Davis, Hager, Rajamanickam 2008); a solve passes over its columns
// once for all three coordinates, and takes up to four columns of nested structure together, as CHOLMOD's own does.

#include <cholmod.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <type_traits>
#include <vector>

using Vector = double __attribute__((vector_size(32)));

constexpr int MAX_COLUMNS = 4;  // as many as fit into registers, with their sums

struct Spring {
    int i, j;
    double kr;  // stiffness times rest length
};

struct Steps {
    cholmod_common c;
    cholmod_factor* L = nullptr;
    std::int64_t n, f;
    std::vector<int> at;      // the vertex of each row: the rows of L, then exactly pinned vertices
    std::vector<int> blocks;  // the first columns of blocks of nested columns, and f
    std::vector<Spring> springs;
    std::vector<double> inverse;  // of D
    std::vector<Vector> p, y, b;

    void gather(std::int64_t count, const double* from, std::vector<Vector>& to) const {
        for (std::int64_t v = 0; v < count; ++v) {
            const double* a = from + 3 * at[v];
            to[v] = Vector{a[0], a[1], a[2], 0.0};
        }
    }

    void scatter(std::int64_t count, const std::vector<Vector>& from, double* to) const {
        for (std::int64_t v = 0; v < count; ++v)
            for (int d = 0; d < 3; ++d) to[3 * at[v] + d] = from[v][d];
    }

    // b = y + A'K d(p)
    void local() {
        constexpr std::size_t WIDTH = 4;  // springs whose square roots and quotients are taken together
        std::copy(y.begin(), y.end(), b.begin());
        const std::size_t m = springs.size();
        for (std::size_t e = 0; e < m; e += WIDTH) {
            const std::size_t count = std::min(WIDTH, m - e);
            Vector d[WIDTH], square{1.0, 1.0, 1.0, 1.0}, kr{};
            for (std::size_t t = 0; t < count; ++t) {
                const Spring& s = springs[e + t];
                d[t] = p[s.i] - p[s.j];
                const Vector q = d[t] * d[t];
                square[t] = q[0] + q[1] + q[2];
                kr[t] = s.kr;
            }
            Vector scale{};
            for (std::size_t t = 0; t < WIDTH; ++t) scale[t] = std::sqrt(square[t]);
            scale = square > 0.0 ? kr / scale : Vector{};
            for (std::size_t t = 0; t < count; ++t) {
                const Vector u = scale[t] * d[t];
                b[springs[e + t].i] += u;
                b[springs[e + t].j] -= u;
            }
        }
    }

    // Forward substitution by columns c to c + W - 1 of L, which have one structure.
    template <int W> void forward(int c, Vector* x) const {
        const int *start = static_cast<int*>(L->p), *row = static_cast<int*>(L->i), *nz = static_cast<int*>(L->nz);
        const double* value[W];
        Vector own[W];
        for (int t = 0; t < W; ++t) {
            value[t] = static_cast<double*>(L->x) + start[c + t] - t;  // entry k belongs to row[start[c] + k]
            own[t] = x[c + t];
            for (int s = 0; s < t; ++s) own[t] -= value[s][t] * own[s];
            x[c + t] = own[t];
        }
        const int* of = row + start[c];
        for (int k = W; k < nz[c]; ++k) {
            Vector sum = value[0][k] * own[0];
            for (int t = 1; t < W; ++t) sum += value[t][k] * own[t];
            x[of[k]] -= sum;
        }
    }

    // Backward substitution by the same columns, and division by D.
    template <int W> void backward(int c, Vector* x) const {
        const int *start = static_cast<int*>(L->p), *row = static_cast<int*>(L->i), *nz = static_cast<int*>(L->nz);
        const double* value[W];
        Vector own[W];
        for (int t = 0; t < W; ++t) {
            value[t] = static_cast<double*>(L->x) + start[c + t] - t;
            own[t] = inverse[c + t] * x[c + t];
        }
        const int* of = row + start[c];
        for (int k = W; k < nz[c]; ++k) {
            const Vector from = x[of[k]];
            for (int t = 0; t < W; ++t) own[t] -= value[t][k] * from;
        }
        for (int t = W - 1; t >= 0; --t) {
            for (int s = t + 1; s < W; ++s) own[t] -= value[t][s] * own[s];
            x[c + t] = own[t];
        }
    }

    // Calls a function with the number of columns of a block as a constant.
    template <class Function> void with_width(std::size_t block, Function function) const {
        switch (blocks[block + 1] - blocks[block]) {
            case 1: function(std::integral_constant<int, 1>()); break;
            case 2: function(std::integral_constant<int, 2>()); break;
            case 3: function(std::integral_constant<int, 3>()); break;
            default: function(std::integral_constant<int, MAX_COLUMNS>());
        }
    }

    // x = (L D L')^-1 x, with rows in the order of L.
    void solve(Vector* x) const {
        for (std::size_t k = 0; k + 1 < blocks.size(); ++k)
            with_width(k, [&](auto width) { forward<width.value>(blocks[k], x); });
        for (std::size_t k = blocks.size() - 1; k-- > 0;)
            with_width(k, [&](auto width) { backward<width.value>(blocks[k], x); });
    }

    // Finds neighbouring columns of one structure: each has the rows of the one before it but the first.
    void find_blocks() {
        const int *start = static_cast<int*>(L->p), *row = static_cast<int*>(L->i), *nz = static_cast<int*>(L->nz);
        auto is_nested = [&](int c) {
            return nz[c] == nz[c - 1] - 1 && std::equal(row + start[c], row + start[c] + nz[c], row + start[c - 1] + 1);
        };
        for (int c = 0; c < f; ++c)
            if (c == 0 || c - blocks.back() == MAX_COLUMNS || !is_nested(c)) blocks.push_back(c);
        blocks.push_back(static_cast<int>(f));
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
    made->p.resize(n), made->y.resize(n), made->b.resize(n);
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
    if (good) {
        std::vector<int> place(n);
        for (std::int64_t v = 0; v < f; ++v) made->at.push_back(free[static_cast<int*>(made->L->Perm)[v]]);
        for (std::int64_t v = 0; v < n; ++v)
            if (row[v] < 0) made->at.push_back(v);
        for (std::int64_t v = 0; v < n; ++v) place[made->at[v]] = v;
        for (std::int64_t e = 0; e < m; ++e)
            made->springs.push_back({place[edges[2 * e]], place[edges[2 * e + 1]], k[e] * rest[e]});
        std::sort(made->springs.begin(), made->springs.end(), [](const Spring& s, const Spring& t) {
            return std::min(s.i, s.j) < std::min(t.i, t.j);  // neighbours in memory
        });
        for (std::int64_t c = 0; c < f; ++c)
            made->inverse.push_back(1.0 / static_cast<double*>(made->L->x)[static_cast<int*>(made->L->p)[c]]);
        made->find_blocks();
        return made;
    }
    cholmod_free_factor(&made->L, c);
    cholmod_finish(c);
    delete made;
    return nullptr;
}

void local(Steps* made, std::int64_t n, const double* p, const double* y, double* b) {
    made->gather(n, p, made->p);
    made->gather(n, y, made->y);
    made->local();
    made->scatter(n, made->b, b);
}

// Solves for the free rows only; b and p have f rows, in the order of the free vertices.
void global_(Steps* made, std::int64_t f, const double* b, double* p) {
    const int* order = static_cast<int*>(made->L->Perm);
    for (std::int64_t v = 0; v < f; ++v) {
        const double* a = b + 3 * order[v];
        made->b[v] = Vector{a[0], a[1], a[2], 0.0};
    }
    made->solve(made->b.data());
    for (std::int64_t v = 0; v < f; ++v)
        for (int d = 0; d < 3; ++d) p[3 * order[v] + d] = made->b[v][d];
}

void iterate(Steps* made, std::int64_t count, double* p, const double* y) {
    made->gather(made->n, p, made->p);
    made->gather(made->n, y, made->y);
    for (; count > 0; --count) {
        made->local();
        made->solve(made->b.data());
        std::copy_n(made->b.begin(), made->f, made->p.begin());
    }
    made->scatter(made->f, made->p, p);
}

void release(Steps* made) {
    cholmod_free_factor(&made->L, &made->c);
    cholmod_finish(&made->c);
    delete made;
}
}
