/* The functions of rows.c for one type, which says what REAL, LANES, SQRT, LARGEST and NAME(x) are.
 *
 * LANES systems are worked on together, one in each lane of a vector, so that each operation on a matrix entry is one
 * instruction for all of them. Their factor lies in block rows of TILE rows: block row I holds columns
 * 0 ... TILE (I + 1) - 1, and for each column its TILE entries, each a vector. The last block is padded with rows of the
 * identity. The diagonal holds reciprocals. */

typedef REAL NAME(vec) __attribute__((vector_size(LANES * sizeof(REAL)), aligned(sizeof(REAL))));
#define VEC NAME(vec)

/* First vector of block row I. */
static inline int64_t NAME(start)(int64_t block) { return (int64_t)TILE * TILE / 2 * block * (block + 1); }

/* Entry (row, column) of gram, of which the upper triangle is read; of the identity beyond its size. */
INLINE REAL NAME(entry)(const REAL *gram, int64_t k, int64_t row, int64_t column) {
    if (row >= k || column >= k) return row == column;
    return row < column ? gram[row * k + column] : gram[column * k + row];
}

/* Sum over columns p < n of block rows `a` and `b`: out[r][s] -= a[p][r] b[p][s]. */
INLINE void NAME(subtract)(const VEC *a, const VEC *b, int64_t n, VEC out[TILE][TILE]) {
    for (int64_t p = 0; p < n; p++, a += TILE, b += TILE)
        for (int r = 0; r < TILE; r++)
            for (int s = 0; s < TILE; s++) out[r][s] -= a[r] * b[s];
}

/* Cholesky of LANES systems gram + diag(diagonal); `fine` becomes 0 in lanes that have none. */
INLINE void NAME(factor)(const REAL *gram, const VEC *diagonal, int64_t k, VEC *factor, VEC *fine) {
    const int64_t blocks = (k + TILE - 1) / TILE;
    const VEC zero = {0};
    VEC good = zero + 1;
    for (int64_t i = 0; i < blocks; i++) {
        VEC *own = factor + NAME(start)(i);
        for (int64_t j = 0; j <= i; j++) {
            const VEC *other = factor + NAME(start)(j);
            VEC tile[TILE][TILE];
            for (int r = 0; r < TILE; r++)
                for (int s = 0; s < TILE; s++) {
                    tile[r][s] = zero + NAME(entry)(gram, k, i * TILE + r, j * TILE + s);
                    if (i == j && r == s && i * TILE + r < k) tile[r][s] += diagonal[i * TILE + r];
                }
            NAME(subtract)(own, other, j * TILE, tile);
            if (j < i) { /* tile L_jj^-T */
                const VEC *corner = other + j * TILE * TILE;
                for (int s = 0; s < TILE; s++)
                    for (int r = 0; r < TILE; r++) {
                        for (int q = 0; q < s; q++) tile[r][s] -= tile[r][q] * corner[q * TILE + s];
                        tile[r][s] *= corner[s * TILE + s];
                    }
            } else {
                for (int s = 0; s < TILE; s++) {
                    for (int q = 0; q < s; q++) tile[s][s] -= tile[s][q] * tile[s][q];
                    for (int l = 0; l < LANES; l++) {
                        const REAL pivot = tile[s][s][l];
                        if (!(pivot > 0 && pivot <= LARGEST)) good[l] = 0;
                        tile[s][s][l] = 1 / SQRT(pivot);
                    }
                    for (int r = s + 1; r < TILE; r++) {
                        for (int q = 0; q < s; q++) tile[r][s] -= tile[r][q] * tile[s][q];
                        tile[r][s] *= tile[s][s];
                    }
                    for (int r = 0; r < s; r++) tile[r][s] = zero;
                }
            }
            for (int s = 0; s < TILE; s++)
                for (int r = 0; r < TILE; r++) own[(j * TILE + s) * TILE + r] = tile[r][s];
        }
    }
    *fine = good;
}

/* x, the right-hand sides, becomes the solutions; it has whole blocks, and what is beyond k must be 0. */
INLINE void NAME(solve)(const VEC *factor, int64_t k, VEC *x) {
    const int64_t blocks = (k + TILE - 1) / TILE;
    for (int64_t i = 0; i < blocks; i++) {
        const VEC *own = factor + NAME(start)(i);
        VEC sum[TILE];
        for (int r = 0; r < TILE; r++) sum[r] = x[i * TILE + r];
        for (int64_t p = 0; p < i * TILE; p++, own += TILE)
            for (int r = 0; r < TILE; r++) sum[r] -= own[r] * x[p];
        for (int r = 0; r < TILE; r++) {
            for (int q = 0; q < r; q++) sum[r] -= own[q * TILE + r] * sum[q];
            sum[r] *= own[r * TILE + r];
            x[i * TILE + r] = sum[r];
        }
    }
    for (int64_t i = blocks - 1; i >= 0; i--) {
        const VEC *own = factor + NAME(start)(i), *corner = own + i * TILE * TILE;
        VEC sum[TILE];
        for (int r = TILE - 1; r >= 0; r--) {
            sum[r] = x[i * TILE + r];
            for (int q = r + 1; q < TILE; q++) sum[r] -= corner[r * TILE + q] * sum[q];
            sum[r] *= corner[r * TILE + r];
            x[i * TILE + r] = sum[r];
        }
        for (int64_t p = 0; p < i * TILE; p++, own += TILE) {
            VEC rest = x[p];
            for (int r = 0; r < TILE; r++) rest -= own[r] * sum[r];
            x[p] = rest;
        }
    }
}

/* Rows `first` ... of (ky, k) numbers, one in each lane; lanes beyond the last row repeat it. */
INLINE void NAME(gather)(const REAL *rows, int64_t k, int64_t ky, int64_t first, VEC *out) {
    for (int l = 0; l < LANES; l++) {
        const REAL *row = rows + k * (first + l < ky ? first + l : ky - 1);
        for (int64_t j = 0; j < k; j++) out[j][l] = row[j];
    }
    for (int64_t j = k; j % TILE; j++) out[j] = (VEC){0};
}

INLINE void NAME(scatter)(const VEC *x, int64_t k, int64_t ky, int64_t first, REAL *rows) {
    for (int l = 0; l < LANES && first + l < ky; l++)
        for (int64_t j = 0; j < k; j++) rows[k * (first + l) + j] = x[j][l];
}

/* Lanes whose system is singular to working precision become 0 in `fine`: solve_checked of cholesky.py, the same steps. */
INLINE void NAME(check)(const VEC *factor, const REAL *gram, const VEC *diagonal, REAL noise, int64_t k, VEC *x, VEC *unit,
                        VEC *fine) {
    const VEC zero = {0};
    VEC largest = zero, once = zero, twice = zero;
    for (int64_t j = 0; j < k; j++) {
        const VEC whole = diagonal[j] + gram[j * k + j];
        for (int l = 0; l < LANES; l++) unit[j][l] = whole[l] > 0 ? SQRT(whole[l]) : 0;
        x[j] = cos((j + 0.5) * (j + 0.5)) > 0 ? unit[j] : -unit[j];
    }
    for (int64_t j = k; j % TILE; j++) x[j] = zero;
    NAME(solve)(factor, k, x);
    for (int64_t j = 0; j < k; j++) {
        x[j] *= unit[j];
        for (int l = 0; l < LANES; l++) {
            const REAL size = x[j][l] < 0 ? -x[j][l] : x[j][l];
            if (size > largest[l]) largest[l] = size;
        }
    }
    for (int64_t j = 0; j < k; j++) {
        x[j] /= largest; /* its square could overflow */
        once += x[j] * x[j];
        x[j] *= unit[j];
    }
    NAME(solve)(factor, k, x);
    for (int64_t j = 0; j < k; j++) {
        x[j] *= unit[j];
        twice += x[j] * x[j];
    }
    for (int l = 0; l < LANES; l++)
        if (!(noise * SQRT(twice[l]) < SQRT(once[l]))) (*fine)[l] = 0;
}

typedef struct {
    const REAL *gram, *diagonal, *rhs;
    REAL noise;
    int64_t n, k, ky, next; /* the first group that no thread has taken */
    REAL *rows, *factors;
    uint8_t *fine;
    int failed;
} NAME(task);

INLINE void BODY(solve_groups)(void *given) {
    NAME(task) *t = given;
    const int64_t k = t->k, ky = t->ky, padded = (k + TILE - 1) / TILE * TILE, groups = (ky + LANES - 1) / LANES;
    const int64_t size = NAME(start)(padded / TILE);
    VEC *space = malloc(sizeof(VEC) * (3 * padded + (t->factors ? 0 : size)));
    if (!space) t->failed = 1;
    for (int64_t g; space && (g = take(&t->next)) < t->n * groups;) {
        const int64_t sample = g / groups, row = g % groups * LANES;
        const REAL *gram = t->gram + sample * k * k;
        VEC *diagonals = space, *x = diagonals + padded, *unit = x + padded, good;
        VEC *factor = t->factors ? (VEC *)t->factors + g * size : unit + padded;
        NAME(gather)(t->diagonal + sample * ky * k, k, ky, row, diagonals);
        NAME(factor)(gram, diagonals, k, factor, &good);
        if (t->noise > 0) NAME(check)(factor, gram, diagonals, t->noise, k, x, unit, &good);
        NAME(gather)(t->rhs + sample * ky * k, k, ky, row, x);
        NAME(solve)(factor, k, x);
        NAME(scatter)(x, k, ky, row, t->rows + sample * ky * k);
        for (int l = 0; l < LANES && row + l < ky; l++) t->fine[sample * ky + row + l] = good[l] != 0;
    }
    free(space);
}

VERSIONS_OF(solve_groups)

INLINE void BODY(solve_groups_again)(void *given) {
    NAME(task) *t = given;
    const int64_t k = t->k, ky = t->ky, padded = (k + TILE - 1) / TILE * TILE, groups = (ky + LANES - 1) / LANES;
    VEC *x = malloc(sizeof(VEC) * padded);
    if (!x) t->failed = 1;
    for (int64_t g; x && (g = take(&t->next)) < t->n * groups;) {
        const int64_t sample = g / groups, row = g % groups * LANES;
        NAME(gather)(t->rhs + sample * ky * k, k, ky, row, x);
        NAME(solve)((const VEC *)t->factors + g * NAME(start)(padded / TILE), k, x);
        NAME(scatter)(x, k, ky, row, t->rows + sample * ky * k);
    }
    free(x);
}

VERSIONS_OF(solve_groups_again)

/* Row i of sample b solves (gram_b + diag(diagonal_bi)) x = rhs_bi. Returns 0, or 1 where there is no memory.
 *
 * gram (n, k, k); diagonal, rhs and rows (n, ky, k). noise: see solve_checked in cholesky.py; 0: singular systems are not
 * looked for. factors: room for those of all groups of LANES rows (each sample has groups of its own), or none. fine
 * (n, ky): 1 where there is a solution. */
EXPORT int NAME(solve_rows)(const REAL *gram, const REAL *diagonal, const REAL *rhs, REAL noise, int64_t n, int64_t k,
                            int64_t ky, int threads, REAL *rows, REAL *factors, uint8_t *fine) {
    NAME(task) task = {gram, diagonal, rhs, noise, n, k, ky, 0, rows, factors, fine, 0};
    in_threads(NAME(solve_groups), &task, threads);
    return task.failed;
}

/* The same systems with other right-hand sides. */
EXPORT int NAME(solve_again)(REAL *factors, const REAL *rhs, int64_t n, int64_t k, int64_t ky, int threads, REAL *rows) {
    NAME(task) task = {.rhs = rhs, .n = n, .k = k, .ky = ky, .rows = rows, .factors = factors};
    in_threads(NAME(solve_groups_again), &task, threads);
    return task.failed;
}
#undef VEC
