// What the kernels use of the platform that compiles them: CUDA (NVRTC), HIP (HIPRTC), or the emulator on a CPU.
//
// KERNEL(threads, blocks)  begins a kernel that is launched with `threads` threads a block, of which at least `blocks`
//                          blocks shall fit on a multiprocessor.
// DEVICE                   begins a function that is inlined into kernels.
// SHARED(type, name, dims) declares an array in the shared memory of a block, aligned to 16 bytes.
// largest_in_block(p, x)   sets *p to x if that is larger, for all threads; count_up(p) adds 1 to *p.
// any_in_warp(condition)   is false only if the condition holds in no thread of the warp.
// votes_of_warp(condition) has bit i set if the condition holds in thread i of the warp.
// lowest_bit(bits)         is the number of the lowest bit that is set.
#ifndef PLATFORM_H
#define PLATFORM_H

#define WARP 32

#if defined(EMULATED)

#include "emulator.h"

#else

#define KERNEL(threads, blocks) extern "C" __global__ void __launch_bounds__(threads, blocks)
#define DEVICE static __device__ __forceinline__
#define SHARED(type, name, dims) __shared__ __align__(16) type name dims
#define THREAD ((int)threadIdx.x)
#define BLOCK ((int)blockIdx.x)
#define THREADS_OF_BLOCK ((int)blockDim.x)
#define INFINITE __longlong_as_double(0x7ff0000000000000LL)

DEVICE void sync_block() { __syncthreads(); }
DEVICE bool any_in_block(bool condition) { return __syncthreads_or(condition); }
DEVICE void largest_in_block(int *place, int value) { atomicMax(place, value); }
DEVICE void count_up(long long *number) { atomicAdd((unsigned long long *)number, 1ULL); }
DEVICE int bits_of(float x) { return __float_as_int(x); }
DEVICE int lowest_bit(unsigned bits) { return __ffs((int)bits) - 1; }

#if defined(__HIP_PLATFORM_AMD__) || defined(__HIP__)

// A wave has 32 or 64 threads, which run together; the fence keeps the order of accesses to shared memory.
DEVICE void sync_warp() {
    __builtin_amdgcn_fence(__ATOMIC_ACQ_REL, "workgroup");
    __builtin_amdgcn_wave_barrier();
}
DEVICE bool any_in_warp(bool condition) { return __any(condition); }
DEVICE unsigned votes_of_warp(bool condition) {
    // Of a wave of 64 threads, those of this half.
    return (unsigned)(__ballot(condition) >> (threadIdx.x & WARP & (warpSize - 1)));
}
DEVICE float reciprocal(float x) { return __builtin_amdgcn_rcpf(x); }

#else

DEVICE void sync_warp() { __syncwarp(); }
DEVICE bool any_in_warp(bool condition) { return __any_sync(0xffffffffu, condition); }
DEVICE unsigned votes_of_warp(bool condition) { return __ballot_sync(0xffffffffu, condition); }
DEVICE float reciprocal(float x) { return __fdividef(1.0f, x); }

#endif
#endif

#define MIN(a, b) ((b) < (a) ? (b) : (a))
#define MAX(a, b) ((b) > (a) ? (b) : (a))

#endif
