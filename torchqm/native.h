/* What the C files share: vectors, several versions of a function for several processors, and threads.
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

/* BYTES of a vector; CLONES: one version each for processors with AVX-512, with AVX2, and others. */
#if defined(__x86_64__) && defined(__GLIBC__)
#define BYTES 32
#define CLONES __attribute__((target_clones("arch=x86-64-v4", "arch=x86-64-v3", "default")))
#define FAST (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma"))
#elif defined(__AVX2__) && defined(__FMA__)
#define BYTES 32
#define CLONES
#define FAST 1
#elif defined(__aarch64__)
#define BYTES 16
#define CLONES
#define FAST 1
#else
#define BYTES 16
#define CLONES
#define FAST 0
#endif

/* Whether this processor has the vector instructions without which other libraries are faster. */
EXPORT int fast(void) { return FAST; }

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
static int64_t take(int64_t *next) { return __atomic_fetch_add(next, 1, __ATOMIC_RELAXED); }
