// The acceleration under contacts and limits by Newton's method: MuJoCo's convex problem (documentation, chapter
// Computation, section Constraint model): the least of 1/2 (a - a0)^T M (a - a0) + s(J a - wanted) over accelerations a,
// where s is quadratic for limits that are closed and for contacts that stick, and bends along the cone where they slide.
//
// A step solves H p = -gradient with H = M + J^T s'' J (elimination.cuh).
#pragma once
#include "rows.cuh"
#include "elimination.cuh"

// Where a contact is with respect to its cone.
struct Cone {
  float slide_y, slide_z, length, inverse;  // of slide, in the scaled space of the cone; 1 / length
  bool bottom, middle;                      // sticking, sliding
  float stiff, inside;                      // along the cone, 0 unless sliding; `short`: how far inside the dual cone
};

DEV Cone cone_at(const ContactRows &rows, Vec3 miss) {
  const float mu = rows.mu, normal = mu * miss.x;
  Cone cone;
  cone.slide_y = rows.friction * miss.y, cone.slide_z = rows.friction * miss.z;
  const float square = cone.slide_y * cone.slide_y + cone.slide_z * cone.slide_z + 1e-15f;
  cone.inverse = rsqrtf(square);
  cone.length = square * cone.inverse;
  cone.bottom = mu * normal + cone.length <= 0;
  cone.middle = !cone.bottom && normal < mu * cone.length;
  cone.stiff = cone.middle ? rows.weight / (mu * mu * (1 + mu * mu)) : 0;
  cone.inside = normal - mu * cone.length;
  return cone;
}

// Force along the rows.
DEV Vec3 cone_force(const ContactRows &rows, const Cone &cone, Vec3 miss) {
  if (cone.bottom) return {-rows.weight * miss.x, -rows.slide_weight * miss.y, -rows.slide_weight * miss.z};
  const float press = -cone.stiff * cone.inside * rows.mu, slide = -press * cone.inverse * rows.friction;
  return {press, slide * cone.slide_y, slide * cone.slide_z};
}

// What a lane has to do with which contacts, as masks over contacts.
struct Whose {
  unsigned mine;     // that the lane adds up: those its hinge moves; of the object's, for its lanes, every GROUPS-th
  unsigned second;   // of these, where the hinge carries the second link
  unsigned object;   // of the object
  unsigned hand;     // between two links of the hand
  unsigned cluster;  // not contacts but lanes: hinges that are coupled to this one but by the object
  int largest;       // hinges of the largest cluster
};

// Hinges that touching fingers couple: contact by contact, the second finger takes the label of the first.
DEV void find_clusters(const ContactRows &rows, Whose &whose, const Lane &lane) {
  int label = lane.hinge ? lane.first : lane.index;
#pragma unroll 1
  for (unsigned left = whose.hand; left; left &= left - 1) {
    const int contact = __ffs(left) - 1;
    const int first = from_lane(label, from_lane(rows.first, contact));
    const int second = from_lane(label, from_lane(rows.second, contact));
    if (label == second) label = first;
  }
  whose.cluster = __match_any_sync(ALL_LANES, label);
  whose.largest = __reduce_max_sync(ALL_LANES, __popc(whose.cluster));
}

DEV Whose whose_contacts(const ContactRows &rows, int contacts, const Lane &lane) {
  const int first = CHAIN_MASK[rows.first < 0 ? HINGES : rows.first];
  const int second = CHAIN_MASK[rows.second < 0 ? HINGES : rows.second] & ~first;
  Whose whose = {};
  whose.object = lanes_where(rows.second == HINGES);
  whose.hand = lanes_where(rows.first >= 0 && rows.second >= 0 && rows.second < HINGES);
#pragma unroll 1
  for (int contact = 0; contact < contacts; contact++) {
    const unsigned on_first = from_lane(first, contact), on_second = from_lane(second, contact);
    whose.mine |= ((on_first | on_second) >> lane.index & 1) << contact;
    whose.second |= (on_second >> lane.index & 1) << contact;
  }
  unsigned every = 0;
#pragma unroll
  for (int contact = 0; contact < 32; contact += GROUPS) every |= 1u << contact;
  if (!lane.hinge) whose.mine = lane.object ? whose.object & (every << lane.group) : 0;
  find_clusters(rows, whose, lane);
  return whose;
}

// What stays the same during a sub-step.
struct Problem {
  ContactRows rows;
  LimitRow limit;
  Whose whose;
  float mass[BLOCK ? BLOCK : 1];  // the lane's row within its finger
  float object_mass[6];
  float force;
};

DEV void load_mass(Problem &problem, Shared &shared, const Lane &lane) {
  if (BLOCK) {
    const float *row = mass_rows(shared) + lane.index * MASS_STRIDE + lane.first;
#pragma unroll
    for (int k = 0; k < BLOCK; k++)
      problem.mass[k] = lane.hinge && lane.first + k <= BLOCK_LAST[lane.index] ? row[k] : 0;
  }
}

// M times `shared.vector`, the lane's row of it.
DEV float mass_times_vector(const Problem &problem, Shared &shared, const Lane &lane) {
  float sum = 0;
  if (BLOCK) {
#pragma unroll
    for (int k = 0; k < BLOCK; k++) sum += problem.mass[k] * shared.vector[lane.first + k];
  } else if (lane.hinge) {
    for (int k = 0; k < HINGES; k++) sum += shared.mass[lane.index * MASS_STRIDE + k] * shared.vector[k];
  }
#pragma unroll
  for (int axis = 0; axis < 6; axis++) sum += problem.object_mass[axis] * shared.vector[HINGES + axis];
  return sum;
}

DEV float dot3(float4 a, float4 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }

// Writes three rows whose squares add up to the contact's part of the Hessian, and minus its force along the columns.
// With weights on the diagonal (sticking) that is sqrt(weight) J; sliding, one row along the cone and one around it.
// Returns which contacts have any.
DEV unsigned write_factors(const ContactRows &rows, Vec3 miss, Shared &shared, const Lane &lane) {
  const Cone cone = cone_at(rows, miss);
  const Vec3 force = cone_force(rows, cone, miss);
  const bool active = rows.here && (cone.bottom || cone.middle);
  Vec3 along;                 // first row, by row of J
  float around_y, around_z;   // second row, which has no part along the normal
  float last = 0;             // third row, along the second tangent only
  if (cone.bottom) {
    along = {sqrtf(rows.weight), 0, 0};
    around_y = last = sqrtf(rows.slide_weight), around_z = 0;
  } else {
    const float y = cone.slide_y * cone.inverse, z = cone.slide_z * cone.inverse, root = sqrtf(cone.stiff);
    along = root * rows.mu * Vec3{1, -rows.friction * y, -rows.friction * z};
    const float bend = rows.friction * sqrtf(cone.stiff * fmaxf(-rows.mu * cone.inside * cone.inverse, 0));
    around_y = -bend * z, around_z = bend * y;
  }
  if (active) {
#pragma unroll
    for (int column = 0; column < COLUMNS; column++) {
      const Vec3 j = {rows.jacobian[0][column], rows.jacobian[1][column], rows.jacobian[2][column]};
      float4 factor;
      factor.x = dot(along, j);
      factor.y = around_y * j.y + around_z * j.z;
      factor.z = last * j.z;
      factor.w = -dot(force, j);
      shared.factor[lane.index * COLUMNS + column] = factor;
    }
  }
  return lanes_where(active);
}

// The rows of the whole hand, from those of the fingers or of the mass matrix, and the contacts that these lack.
DEV void whole_rows(const float (&finger)[FINGER], float (&row)[WHOLE], const Problem &problem, unsigned contacts,
                    float limit, Shared &shared, const Lane &lane) {
  if (!lane.hinge) return;
  float *own = hand_row(shared, lane.index) + 8;
#pragma unroll
  for (int k = 0; k < WHOLE; k++) own[k] = BLOCK || k >= HINGES ? 0 : shared.mass[lane.index * MASS_STRIDE + k];
  if (BLOCK) {
#pragma unroll
    for (int k = 0; k < BLOCK; k++)
      if (lane.first + k <= BLOCK_LAST[lane.index]) own[lane.first + k] = finger[k];
  } else {
    own[lane.index] += limit;
  }
#pragma unroll 1
  for (unsigned left = contacts & problem.whose.mine; left; left &= left - 1) {
    const int contact = __ffs(left) - 1;
    const Pair &pair = PAIR[shared.contact[contact].pair];
    const bool second = problem.whose.second >> contact & 1;
    const float4 *factor = shared.factor + contact * COLUMNS, mine = factor[(second ? CHAIN : 0) + lane.depth];
#pragma unroll 1
    for (int side = 0; side < 2; side++) {
      const int link = side ? pair.second : pair.first;
      if (link < 0 || link >= HINGES || (BLOCK && side == second)) continue;
#pragma unroll 1
      for (int k = 0; k <= DEPTH[link]; k++) own[CHAIN_HINGE[link][k]] += dot3(mine, factor[side * CHAIN + k]);
    }
  }
#pragma unroll
  for (int k = 0; k < WHOLE; k++) row[k] = own[k];
}

// The Newton step of the lane's degree of freedom from its gradient without constraints; `decrement` is the lane's
// part of -gradient p.
DEV float newton_step(const Problem &problem, Vec3 miss, float acceleration, float gradient, Shared &shared,
                      float &decrement, const Lane &lane) {
  const unsigned active = write_factors(problem.rows, miss, shared, lane);
  float finger[FINGER];
  Side side;
#pragma unroll
  for (int k = 0; k < FINGER; k++) finger[k] = k < BLOCK ? problem.mass[k < BLOCK ? k : 0] : 0;
#pragma unroll
  for (int axis = 0; axis < 6; axis++) side.object[axis] = problem.object_mass[axis];
  const float short_by = problem.limit.side * acceleration - problem.limit.wanted;
  const float limit = short_by < 0 ? problem.limit.weight : 0;
  gradient += limit * short_by * problem.limit.side;
#pragma unroll
  for (int k = 0; k < BLOCK; k++) finger[k] += k == lane.depth ? limit : 0;
  __syncwarp();
#pragma unroll 1
  for (unsigned left = active & problem.whose.mine; left; left &= left - 1) {
    const int contact = __ffs(left) - 1;
    const float4 *factor = shared.factor + contact * COLUMNS;
    const float4 *own = factor + (problem.whose.second >> contact & 1 ? CHAIN : 0);
    const float4 mine = lane.hinge ? own[lane.depth] : factor[CHAIN + lane.axis];
    gradient += mine.w;
    if (BLOCK && lane.hinge) {
#pragma unroll
      for (int k = 0; k < BLOCK; k++) finger[k] += dot3(mine, own[k]);
    }
    if (problem.whose.object >> contact & 1) {
#pragma unroll
      for (int axis = 0; axis < 6; axis++) side.object[axis] += dot3(mine, factor[CHAIN + axis]);
    }
  }
  side.right = -gradient;
  const unsigned among = active & problem.whose.hand;
  const bool whole = !BLOCK || among;
  const Order order =
      whole ? Order{problem.whose.cluster, problem.whose.largest, 0} : Order{lane.finger, BLOCK, lane.first};
  if (whole) {
    float row[WHOLE];
    __syncwarp();
    whole_rows(finger, row, problem, BLOCK ? among : active, limit, shared, lane);
    __syncwarp();
    eliminate(row, side, order, shared, lane);
  } else {
    eliminate(finger, side, order, shared, lane);
  }
  float inverse = 0;
  if (lane.hinge) {
    float *own = hand_row(shared, lane.index);
    inverse = own[7] = 1 / own[8 + lane.index - order.origin];
  }
  decrement = side.right * side.right * inverse;
  __syncwarp();
  float step[6];
  solve_object(side, shared, step, decrement, lane);
#pragma unroll
  for (int axis = 0; axis < 6; axis++) side.right -= side.object[axis] * step[axis];
  const float hinge = substitute(side.right, inverse, order, shared, lane);
  const float object = lane.axis == 0 ? step[0] : lane.axis == 1 ? step[1] : lane.axis == 2 ? step[2]
                     : lane.axis == 3 ? step[3] : lane.axis == 4 ? step[4] : step[5];
  return lane.hinge ? hinge : object;
}

// How far along a step the cost is least: Newton's method on its slope, which only rises, in a bracket.
// `line`: slope at 0 and curvature without constraints.
DEV float line_search(const Args &args, const Problem &problem, Vec3 miss, Vec3 moved, float acceleration, float step,
                      float line_slope, float line_curve, float decrement, int &evaluations, const Lane &lane) {
  const ContactRows &rows = problem.rows;
  const LimitRow &limit = problem.limit;
  const float across_y = rows.friction * moved.y, across_z = rows.friction * moved.z;
  float here = 1, low = 0, high = 1e6f;
#pragma unroll 1
  for (int evaluation = 0; evaluation < args.line_search; evaluation++) {
    evaluations++;
    const Vec3 now = miss + here * moved;
    const Cone cone = cone_at(rows, now);
    float slope = 0, curve = 0;
    if (cone.bottom) {
      slope = rows.weight * now.x * moved.x + rows.slide_weight * (now.y * moved.y + now.z * moved.z);
      curve = rows.weight * moved.x * moved.x + rows.slide_weight * (moved.y * moved.y + moved.z * moved.z);
    } else {
      const float along = (cone.slide_y * across_y + cone.slide_z * across_z) * cone.inverse;
      const float bend = (across_y * across_y + across_z * across_z - along * along) * cone.inverse;
      const float rate = rows.mu * (moved.x - along);
      slope = cone.stiff * cone.inside * rate;
      curve = cone.stiff * (rate * rate - cone.inside * rows.mu * bend);
    }
    const float short_by = limit.side * (acceleration + here * step) - limit.wanted;
    if (short_by < 0) {
      slope += limit.weight * short_by * limit.side * step;
      curve += limit.weight * step * step;
    }
    sum_lanes(slope, curve, lane.index);
    slope += line_slope + here * line_curve;
    curve += line_curve;
    if (fabsf(slope) <= args.line_search_tolerance * decrement) break;
    if (slope < 0) low = here;
    else high = here;
    const float newton = here - slope / fmaxf(curve, 1e-15f);
    here = newton >= low && newton <= high ? newton : 0.5f * (low + high);
  }
  return here;
}

// Whether the lane's constraints are quadratic all the way between two points: its contact sticks or is open at both
// ends, its limit is closed or open at both. Where all are, one whole Newton step has found the solution.
DEV bool quadratic(const Problem &problem, Vec3 before, Vec3 after, float acceleration, float step) {
  const Cone from = cone_at(problem.rows, before), to = cone_at(problem.rows, after);
  const LimitRow &limit = problem.limit;
  const bool closed_before = limit.side * acceleration < limit.wanted;
  const bool closed_after = limit.side * (acceleration + step) < limit.wanted;
  const bool same = !from.middle && !to.middle && from.bottom == to.bottom;
  return (same || !problem.rows.here) && closed_before == closed_after;
}

// The acceleration of the lane's degree of freedom, from the last one on. `miss` of the rows ends as that of the
// solution. Counts iterations and evaluations of the line search.
DEV float solve(const Args &args, Problem &problem, float acceleration, Shared &shared, int &iterations,
                int &evaluations, const Lane &lane) {
  // Contacts that slip and stick change accelerations a lot: a quarter of the last one is a better first guess than all
  // of it or nothing (rotate: 5.7 iterations on average, not 6.2 or 5.8).
  acceleration *= 0.25f;
  if (lane.dof) shared.vector[lane.index] = acceleration;
  __syncwarp();
  Vec3 &miss = problem.rows.miss;
  miss += times(problem.rows, shared.vector);
  float inertial = mass_times_vector(problem, shared, lane);
  __syncwarp();
#pragma unroll 1
  for (int iteration = 0; iteration < args.iterations; iteration++) {
    iterations++;
    float decrement;
    const float gradient = lane.dof ? inertial - problem.force : 0;
    float step = newton_step(problem, miss, acceleration, gradient, shared, decrement, lane);
    if (!lane.dof) step = 0;
    if (lane.dof) shared.vector[lane.index] = step;
    __syncwarp();
    const Vec3 moved = times(problem.rows, shared.vector);
    const float inertial_step = mass_times_vector(problem, shared, lane);
    float slope = step * gradient, curve = step * inertial_step;
    sum_lanes(slope, curve, lane.index);
    decrement = sum_lanes(decrement);
    // The last step is taken as it is: its slopes are rounding.
    const bool last = decrement < args.tolerance;
    float share = 1;
    if (!last)
      share = line_search(args, problem, miss, moved, acceleration, step, slope, curve, decrement, evaluations, lane);
    const bool found = share == 1 && lanes_where(!quadratic(problem, miss, miss + moved, acceleration, step)) == 0;
    acceleration += share * step;
    inertial += share * inertial_step;
    miss += share * moved;
    __syncwarp();
    if (last || found) break;
  }
  return acceleration;
}
