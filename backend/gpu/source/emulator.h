// Execution of a kernel on a CPU, in place of a GPU in tests: one thread of a block runs at a time, up to its next
// barrier. After each barrier the order of the threads is reversed, and shared memory begins as NaN, so that a kernel
// with a missing barrier, or one that reads what it has not written, gives a wrong result. A barrier that only a part of
// the threads reaches ends the launch with an error.
#ifndef EMULATOR_H
#define EMULATOR_H

#include <math.h>
#include <setjmp.h>
#include <stdlib.h>
#include <string.h>
#include <ucontext.h>

#include <utility>
#include <vector>

#define KERNEL(threads, blocks) static void
#define DEVICE static inline
#define SHARED(type, name, dims) \
    typedef type shape_of_##name dims; \
    shape_of_##name &name = *(shape_of_##name *)emulator::shared_memory(__LINE__, sizeof(shape_of_##name))
#define THREAD (emulator::current->index)
#define BLOCK (emulator::block)
#define THREADS_OF_BLOCK (emulator::threads)
#define INFINITE __builtin_inf()

namespace emulator {

enum State { READY, AT_BLOCK_BARRIER, AT_WARP_BARRIER, DONE };

struct Thread {
    int index;
    State state;
    bool vote, started;
    unsigned votes;
    ucontext_t context;
    jmp_buf place;
    std::vector<char> stack;
};

struct Array {
    int line;
    std::vector<long long> memory;
};

static int block, threads;
static Thread *current;
static std::vector<Thread *> pool;
static std::vector<Array> arrays;
static jmp_buf scheduler;
static void (*work)(void **);
static void **parameters;

static void *shared_memory(int line, size_t size) {
    for (Array &array : arrays)
        if (array.line == line) return array.memory.data();
    // All bits of a NaN, or -1.
    arrays.push_back({line, std::vector<long long>(size / 8 + 1, -1)});
    return arrays.back().memory.data();
}

static void wait(State barrier) {
    current->state = barrier;
    if (!_setjmp(current->place)) _longjmp(scheduler, 1);
}

static void begin() {
    work(parameters);
    current->state = DONE;
    _longjmp(scheduler, 1);
}

static void resume(Thread *thread) {
    current = thread;
    if (_setjmp(scheduler)) return;
    if (thread->started) _longjmp(thread->place, 1);
    thread->started = true;
    getcontext(&thread->context);
    thread->context.uc_stack.ss_sp = thread->stack.data();
    thread->context.uc_stack.ss_size = thread->stack.size();
    thread->context.uc_link = nullptr;
    makecontext(&thread->context, begin, 0);
    setcontext(&thread->context);
}

// Lets threads go on if all of `first` to `last` - 1 that have not ended wait at `barrier`; returns whether they do.
static bool release(int first, int last, State barrier) {
    int waiting = 0;
    bool any = false;
    unsigned votes = 0;
    for (int i = first; i < last; i++) {
        if (pool[i]->state == DONE) continue;
        if (pool[i]->state != barrier) return false;
        waiting++;
        any |= pool[i]->vote;
        votes |= (unsigned)pool[i]->vote << i % WARP;
    }
    for (int i = first; i < last; i++)
        if (pool[i]->state == barrier) pool[i]->state = READY, pool[i]->vote = any, pool[i]->votes = votes;
    return waiting > 0;
}

// Runs all blocks; returns false if a barrier was reached by a part of the threads only.
static bool run(void (*kernel)(void **), void **arguments, int blocks, int threads_of_block) {
    work = kernel, parameters = arguments, threads = threads_of_block;
    while ((int)pool.size() < threads)
        pool.push_back(new Thread{(int)pool.size(), DONE, false, false, 0, {}, {}, std::vector<char>(65536)});
    for (block = 0; block < blocks; block++) {
        arrays.clear();
        for (int i = 0; i < threads; i++) pool[i]->state = READY, pool[i]->started = pool[i]->vote = false;
        for (bool backwards = false, going = true; going; backwards = !backwards) {
            for (int i = 0; i < threads; i++) {
                Thread *thread = pool[backwards ? threads - 1 - i : i];
                if (thread->state == READY) resume(thread);
            }
            going = release(0, threads, AT_BLOCK_BARRIER);
            for (int first = 0; first < threads; first += WARP)
                going |= release(first, first + WARP < threads ? first + WARP : threads, AT_WARP_BARRIER);
        }
        for (int i = 0; i < threads; i++)
            if (pool[i]->state != DONE) return false;
    }
    return true;
}

template <typename... P, size_t... I>
static void call(void (*kernel)(P...), void **arguments, std::index_sequence<I...>) {
    kernel(*(P *)arguments[I]...);
}

template <typename... P>
static void call(void (*kernel)(P...), void **arguments) {
    call(kernel, arguments, std::index_sequence_for<P...>());
}

}  // namespace emulator

#define EMULATE(kernel) \
    static void call_##kernel(void **arguments) { emulator::call(kernel, arguments); } \
    extern "C" bool launch(void **arguments, int blocks, int threads) { \
        return emulator::run(call_##kernel, arguments, blocks, threads); \
    }

DEVICE void sync_block() { emulator::wait(emulator::AT_BLOCK_BARRIER); }
DEVICE void sync_warp() { emulator::wait(emulator::AT_WARP_BARRIER); }
DEVICE bool any_in_block(bool condition) {
    emulator::current->vote = condition;
    sync_block();
    return emulator::current->vote;
}
DEVICE bool any_in_warp(bool condition) {
    emulator::current->vote = condition;
    sync_warp();
    return emulator::current->vote;
}
DEVICE unsigned votes_of_warp(bool condition) {
    any_in_warp(condition);
    return emulator::current->votes;
}
DEVICE int lowest_bit(unsigned bits) { return __builtin_ctz(bits); }
DEVICE void largest_in_block(int *place, int value) { *place = *place < value ? value : *place; }
DEVICE void count_up(long long *number) { ++*number; }
DEVICE float reciprocal(float x) { return 1.0f / x; }
DEVICE int bits_of(float x) {
    int bits;
    memcpy(&bits, &x, sizeof bits);
    return bits;
}

#endif
