/* What the C files share: vectors, versions of a function for several processors, and threads.
 *
 * Plain C with the vector types of GCC and Clang, no Python: torchqm/native.py loads the libraries by ctypes. Where they
 * cannot be built, others do the same more slowly. */

#include <pthread.h>
#include <stdint.h>
#include <stdlib.h>
#ifdef __linux__
#include <sys/mman.h>
#endif

#define MOST_THREADS 64
#define INLINE static inline __attribute__((always_inline))
#define EXPORT __attribute__((visibility("default")))

/* BYTES of a vector, and whether this processor has the instructions without which other libraries are faster. VERSIONS
 * makes `static void name(void *)` of an inlined function `name_body`: compiled for AVX-512, for AVX2 and for any processor,
 * and chosen when it is called. (On ARM it was never measured.) */
#if defined(__x86_64__)
#define BYTES 32
#define HAS(feature) __builtin_cpu_supports(feature)
#define AVX2 (HAS("avx2") && HAS("fma"))
#define AVX512 (AVX2 && HAS("avx512f") && HAS("avx512vl") && HAS("avx512dq") && HAS("avx512bw"))
#define FAST AVX2
#define VERSIONS(name)                                                                                                       \
    __attribute__((target("avx512f,avx512vl,avx512dq,avx512bw,avx2,fma"))) static void name##_512(void *t) { name##_body(t); } \
    __attribute__((target("avx2,fma"))) static void name##_256(void *t) { name##_body(t); }                                  \
    static void name##_128(void *t) { name##_body(t); }                                                                      \
    static void name(void *t) { (AVX512 ? name##_512 : AVX2 ? name##_256 : name##_128)(t); }
#else
#define BYTES 16
#ifdef __aarch64__
#define FAST 1
#else
#define FAST 0
#endif
#define VERSIONS(name) \
    static void name(void *t) { name##_body(t); }
#endif

EXPORT int fast(void) { return FAST; }

/* Raised with every change of what an exported function takes: what was built of older files is then left alone. */
EXPORT int abi(void) { return 1; }

/* Ask for large pages for memory that nobody has touched: a fault for each of 4 kB took longer than the factors that
 * were written there. No more than advice; where it is not taken, nothing else changes. */
EXPORT void large_pages(void *memory, int64_t bytes) {
#ifdef MADV_HUGEPAGE
    const uintptr_t page = (uintptr_t)1 << 21, first = ((uintptr_t)memory + page - 1) & ~(page - 1);
    const uintptr_t last = ((uintptr_t)memory + (uintptr_t)bytes) & ~(page - 1);
    if (first < last) madvise((void *)first, last - first, MADV_HUGEPAGE);
#else
    (void)memory, (void)bytes;
#endif
}

/* OpenMP's "run this in n threads", from the library whose threads torch uses; none: threads of our own. Torch's threads
 * spin for milliseconds after each operation in case there is another, and whoever is not one of them has to share a core
 * with them. */
static void (*team)(void (*)(void *), void *, unsigned, unsigned);
EXPORT void use_team(void *gomp_parallel) { team = (void (*)(void (*)(void *), void *, unsigned, unsigned))gomp_parallel; }

typedef struct {
    void (*run)(void *);
    void *task;
} call;

static void *in_thread(void *given) {
    const call *c = given;
    c->run(c->task);
    return NULL;
}

/* Run `run(task)` in `n` threads, this one among them; each takes parts of the task until none is left. */
static void in_threads(void (*run)(void *), void *task, int n) {
    call same = {run, task};
    pthread_t others[MOST_THREADS];
    int started = 0;
    if (n > 1 && team) {
        team(run, task, (unsigned)n, 0);
        return;
    }
    while (started < n - 1 && started < MOST_THREADS && !pthread_create(&others[started], NULL, in_thread, &same)) started++;
    run(task);
    while (started) pthread_join(others[--started], NULL);
}

/* The next part that no thread has taken. */
INLINE int64_t take(int64_t *next) { return __atomic_fetch_add(next, 1, __ATOMIC_RELAXED); }
