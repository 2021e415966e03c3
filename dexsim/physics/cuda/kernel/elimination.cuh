// The linear system of a Newton step: an arrow. Fingers are coupled to the object, not to each other, so each finger is
// eliminated by its own lanes, all fingers at once, and what remains is the object's 6 x 6. Fingers that touch each
// other are eliminated together, as is a hand that is not made of short fingers, with rows over all hinges.
#pragma once
#include "shared.cuh"

// A lane's row of the hand's linear system but for the columns of hinges: the object's six, right-hand side.
struct Side {
  float object[6];
  float right;
};

// In shared memory: the object's six, right-hand side, inverse of the pivot, then the hinges.
DEV float *hand_row(Shared &shared, int hinge) { return (float *)(shared.hand + hinge * ROW); }

// In which order hinges are eliminated: those of the lane's cluster, which are coupled to each other, one by one. All
// clusters at once.
struct Order {
  unsigned cluster;  // lanes
  int pivots;        // hinges of the largest cluster
  int origin;        // hinge of a row's first column
};

constexpr int rounded(int count) { return 4 * ((count + 3) / 4); }
constexpr int FINGER = BLOCK ? rounded(BLOCK) : 4, WHOLE = rounded(HINGES);

// Gaussian elimination in each cluster, one pivot after another: its lane writes its row, lanes after it take their
// share off. The matrix stays symmetric, so a lane finds its own entry of the pivot's column in the pivot's row.
template <int WIDTH>
DEV void eliminate(float (&row)[WIDTH], Side &side, const Order &order, Shared &shared, const Lane &lane) {
  unsigned left = order.cluster;
#pragma unroll 1
  for (int k = 0; k < order.pivots; k++) {
    const int pivot = __ffs(left) - 1;
    left &= left - 1;
    if (lane.hinge && lane.index == pivot) {
      float4 *to = shared.hand + lane.index * ROW;
      to[0] = {side.object[0], side.object[1], side.object[2], side.object[3]};
      to[1] = {side.object[4], side.object[5], side.right, 0};
#pragma unroll
      for (int i = 0; i < WIDTH; i += 4) to[2 + i / 4] = {row[i], row[i + 1], row[i + 2], row[i + 3]};
    }
    __syncwarp();
    if (lane.hinge && left >> lane.index & 1) {
      const float4 *from = shared.hand + pivot * ROW;
      const float *columns = (const float *)(from + 2) - order.origin;
      const float share = columns[lane.index] / columns[pivot];
      const float4 a = from[0], b = from[1];
      side.object[0] -= share * a.x, side.object[1] -= share * a.y, side.object[2] -= share * a.z;
      side.object[3] -= share * a.w, side.object[4] -= share * b.x, side.object[5] -= share * b.y;
      side.right -= share * b.z;
#pragma unroll
      for (int i = 0; i < WIDTH; i += 4) {
        const float4 c = from[2 + i / 4];
        row[i] -= share * c.x, row[i + 1] -= share * c.y, row[i + 2] -= share * c.z, row[i + 3] -= share * c.w;
      }
    }
  }
}

// The hinge's part of the step once the object's is known: back-substitution, last pivot first.
DEV float substitute(float right, float inverse, const Order &order, Shared &shared, const Lane &lane) {
  const float *own = hand_row(shared, lane.hinge ? lane.index : 0) + 8 - order.origin;
  unsigned left = order.cluster;
  float step = 0;
#pragma unroll 1
  for (int k = 0; k < order.pivots; k++) {
    const int pivot = left ? 31 - __clz(left) : lane.index;
    if (left && lane.index == pivot) step = right * inverse;
    const float solved = from_lane(step, pivot);
    if (lane.hinge && lane.index < pivot) right -= own[pivot] * solved;
    left &= (1u << pivot) - 1;
  }
  return step;
}

// What the eliminated hinges leave of the object's 6 x 6, and its solution [6], the same on all lanes. Adds to
// `decrement` the object's part on the last lane.
DEV void solve_object(const Side &side, Shared &shared, float (&step)[6], float &decrement, const Lane &lane) {
  float sums[7] = {side.object[0], side.object[1], side.object[2], side.object[3],
                   side.object[4], side.object[5], side.right};
  if (lane.object) {
#pragma unroll
    for (int i = 0; i < (HINGES + GROUPS - 1) / GROUPS; i++) {
      const int hinge = i * GROUPS + lane.group;
      if (hinge < HINGES) {
        const float4 a = shared.hand[hinge * ROW], b = shared.hand[hinge * ROW + 1];
        const float share = hand_row(shared, hinge)[lane.axis] * b.w;
        sums[0] -= share * a.x, sums[1] -= share * a.y, sums[2] -= share * a.z, sums[3] -= share * a.w;
        sums[4] -= share * b.x, sums[5] -= share * b.y, sums[6] -= share * b.z;
      }
    }
  }
#pragma unroll
  for (int k = 0; k < 7; k++) {
    const float own = sums[k];
#pragma unroll
    for (int group = 1; group < GROUPS; group++) sums[k] += from_lane(own, lane.index + 6 * group);
  }
  if (lane.dof && !lane.hinge) {
    shared.object[2 * lane.axis] = {sums[0], sums[1], sums[2], sums[3]};
    shared.object[2 * lane.axis + 1] = {sums[4], sums[5], sums[6], 0};
  }
  __syncwarp();
  float matrix[6][6], pivot[6];
#pragma unroll
  for (int i = 0; i < 6; i++) {
    const float4 a = shared.object[2 * i], b = shared.object[2 * i + 1];
    matrix[i][0] = a.x, matrix[i][1] = a.y, matrix[i][2] = a.z, matrix[i][3] = a.w;
    matrix[i][4] = b.x, matrix[i][5] = b.y;
    step[i] = b.z;
  }
  float part = 0;
#pragma unroll
  for (int k = 0; k < 6; k++) {
    pivot[k] = 1 / matrix[k][k];
    part += step[k] * step[k] * pivot[k];
#pragma unroll
    for (int i = k + 1; i < 6; i++) {
      const float share = matrix[i][k] * pivot[k];
      step[i] -= share * step[k];
#pragma unroll
      for (int j = k + 1; j <= i; j++) matrix[i][j] -= share * matrix[j][k];
    }
  }
#pragma unroll
  for (int k = 5; k >= 0; k--) {
#pragma unroll
    for (int j = k + 1; j < 6; j++) step[k] -= matrix[j][k] * step[j];
    step[k] *= pivot[k];
  }
  if (lane.index == 31) decrement += part;
}
