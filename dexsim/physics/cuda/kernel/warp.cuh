// What the 32 lanes of a warp do together, and vectors of three.
//
// A warp simulates one world. Every function here that talks of "all lanes" has to be reached by all 32 of them.
#pragma once

#ifndef DEV  // a compiler for CPUs defines its own (tests/support/warp_emulation)
#define DEV __device__ __forceinline__
#define DEV_CALL __device__ __noinline__  // smaller code: the instruction cache is what bounds this kernel
#endif

constexpr unsigned ALL_LANES = 0xffffffffu;

DEV float from_lane(float value, int lane) { return __shfl_sync(ALL_LANES, value, lane); }
DEV int from_lane(int value, int lane) { return __shfl_sync(ALL_LANES, value, lane); }
DEV unsigned lanes_where(bool condition) { return __ballot_sync(ALL_LANES, condition); }
DEV unsigned lanes_before(int lane) { return (1u << lane) - 1; }

// Sums over all lanes, the same on each and in the same order every time.
DEV float sum_lanes(float value) {
#pragma unroll
  for (int offset = 16; offset; offset >>= 1) value += __shfl_xor_sync(ALL_LANES, value, offset);
  return value;
}

// Two sums for little more than one: each half of the warp adds up one of them.
DEV void sum_lanes(float &first, float &second, int lane) {
  const bool upper = lane & 16;
  float kept = upper ? second : first;
  const float given = upper ? first : second;
  kept += __shfl_xor_sync(ALL_LANES, given, 16);
#pragma unroll
  for (int offset = 8; offset; offset >>= 1) kept += __shfl_xor_sync(ALL_LANES, kept, offset);
  const float other = __shfl_xor_sync(ALL_LANES, kept, 16);
  first = upper ? other : kept;
  second = upper ? kept : other;
}

DEV float least_of_lanes(float value) {
#pragma unroll
  for (int offset = 16; offset; offset >>= 1) value = fminf(value, __shfl_xor_sync(ALL_LANES, value, offset));
  return value;
}

DEV float greatest_of_lanes(float value) {
#pragma unroll
  for (int offset = 16; offset; offset >>= 1) value = fmaxf(value, __shfl_xor_sync(ALL_LANES, value, offset));
  return value;
}

struct Vec3 {
  float x, y, z;
};

DEV Vec3 load3(const float *from) { return {from[0], from[1], from[2]}; }
DEV Vec3 operator+(Vec3 a, Vec3 b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
DEV Vec3 operator-(Vec3 a, Vec3 b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
DEV Vec3 operator-(Vec3 a) { return {-a.x, -a.y, -a.z}; }
DEV Vec3 operator*(float s, Vec3 a) { return {s * a.x, s * a.y, s * a.z}; }
DEV Vec3 operator*(Vec3 a, float s) { return s * a; }
DEV Vec3 &operator+=(Vec3 &a, Vec3 b) { return a = a + b; }
DEV Vec3 &operator-=(Vec3 &a, Vec3 b) { return a = a - b; }
DEV float dot(Vec3 a, Vec3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
DEV Vec3 cross(Vec3 a, Vec3 b) { return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x}; }
DEV Vec3 absolute(Vec3 a) { return {fabsf(a.x), fabsf(a.y), fabsf(a.z)}; }
DEV Vec3 from_lane(Vec3 a, int lane) { return {from_lane(a.x, lane), from_lane(a.y, lane), from_lane(a.z, lane)}; }

// An index that is not known to the compiler would send the vector from registers to memory.
DEV float pick(Vec3 a, int axis) { return axis == 0 ? a.x : axis == 1 ? a.y : a.z; }

struct Mat3 {
  Vec3 x, y, z;  // rows
};

DEV Vec3 operator*(const Mat3 &m, Vec3 v) { return {dot(m.x, v), dot(m.y, v), dot(m.z, v)}; }
DEV Vec3 transposed_times(const Mat3 &m, Vec3 v) { return v.x * m.x + v.y * m.y + v.z * m.z; }
DEV Vec3 row_times(Vec3 row, const Mat3 &m) { return transposed_times(m, row); }
DEV Mat3 operator*(const Mat3 &a, const Mat3 &b) { return {row_times(a.x, b), row_times(a.y, b), row_times(a.z, b)}; }
DEV Mat3 operator+(const Mat3 &a, const Mat3 &b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
DEV Mat3 operator*(float s, const Mat3 &a) { return {s * a.x, s * a.y, s * a.z}; }
DEV Vec3 column(const Mat3 &m, int axis) { return {pick(m.x, axis), pick(m.y, axis), pick(m.z, axis)}; }
DEV Mat3 from_lane(const Mat3 &m, int lane) { return {from_lane(m.x, lane), from_lane(m.y, lane), from_lane(m.z, lane)}; }

// Rows of the rotation of a unit quaternion (w, x, y, z).
DEV Mat3 rotation_of(float w, float x, float y, float z) {
  return {{1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)},
          {2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)},
          {2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)}};
}
