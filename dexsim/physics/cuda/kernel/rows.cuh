// The constraints of a sub-step: contacts of three rows each (a contact a lane), limits (a hinge a lane), coupled
// joints.
//
// The equations are those of MuJoCo's documentation, chapter Computation, sections Constraint model and Parameters.
#pragma once
#include "dynamics.cuh"

// Stiffness 1/s^2, damping 1/s and impedance of a row.
struct Spring {
  float stiffness, damping, impedance;
};

// MuJoCo's spring from solref [2] and solimp [5] at a gap: stiffness k and damping b of the reference acceleration -b J v -
// k d r, and the impedance d, which rises from solimp[0] to solimp[1] over the depth solimp[2].
DEV Spring spring(const float *solref, const float *solimp, float gap) {
  const float low = fminf(fmaxf(solimp[0], 1e-4f), 0.9999f), high = fminf(fmaxf(solimp[1], 1e-4f), 0.9999f);
  const float middle = fminf(fmaxf(solimp[3], 1e-4f), 0.9999f), power = fmaxf(solimp[4], 1.f);
  const float period = fmaxf(solref[0], 2 * TIMESTEP), hard = high * period * solref[1];
  Spring found;
  found.stiffness = solref[0] > 0 ? 1 / (hard * hard) : -solref[0] / (high * high);
  found.damping = solref[1] > 0 ? 2 / (high * period) : -solref[1] / high;
  const float deep = fminf(fabsf(gap) / fmaxf(solimp[2], 1e-15f), 1.f);
  const bool rises = deep < middle;
  // Both halves are the same curve, the second one seen from its end.
  const float part = rises ? deep : 1 - deep, whole = rises ? middle : 1 - middle;
  // (part / whole)^power * whole. The power is 2 nearly always.
  const float ratio = part / whole, bent = whole * (power == 2 ? ratio * ratio : __powf(ratio, power));
  found.impedance = low + (rises ? bent : 1 - bent) * (high - low);
  return found;
}

// One contact: what `newton.Rows` holds of it.
struct ContactRows {
  bool here;
  int first, second;            // links; second is HINGES for the object
  int first_dof, other_dof;     // of their first columns, where fingers are chains (BLOCK)
  int finger;                   // that the object presses at its tip, or -1
  Vec3 normal;                  // from the first link to the second
  float jacobian[3][COLUMNS];   // normal and two tangents
  Vec3 miss;                    // m/s^2, J a - wanted
  float weight, slide_weight;   // kg, MuJoCo's efc_D of the normal and of the tangents
  float mu, friction;           // of the regularised cone; of the tangents
};

// Degree of freedom of a column. Unused columns are zero, and get one that exists.
DEV int column_dof(const ContactRows &rows, int column) {
  const bool other = column >= CHAIN;
  const int k = other ? column - CHAIN : column;
  if (BLOCK) return (other ? rows.other_dof : rows.first_dof) + k;
  const int link = other ? rows.second : rows.first;
  if (link == HINGES) return HINGES + k;
  return link < 0 || k >= CHAIN || CHAIN_HINGE[link][k] < 0 ? 0 : CHAIN_HINGE[link][k];
}

// J times a vector by degree of freedom.
DEV Vec3 times(const ContactRows &rows, const float *vector) {
  Vec3 sum = {0, 0, 0};
#pragma unroll
  for (int column = 0; column < COLUMNS; column++) {
    const float value = vector[column_dof(rows, column)];
    sum += value * Vec3{rows.jacobian[0][column], rows.jacobian[1][column], rows.jacobian[2][column]};
  }
  return sum;
}

// Rows: the normal and two tangents, chosen as by mju_makeFrame: of the y and z axes that which is less along the
// normal, made orthogonal to it.
DEV Mat3 contact_frame(Vec3 normal) {
  const bool upright = fabsf(normal.y) < 0.5f;
  const Vec3 other = {0, upright ? 1.f : 0.f, upright ? 0.f : 1.f};
  Vec3 side = other - (upright ? normal.y : normal.z) * normal;
  side = rsqrtf(dot(side, side) + 1e-20f) * side;
  return {normal, side, cross(normal, side)};
}

// The hinges that carry a link move its contact point: columns `start`... of the Jacobian, times `sign`.
DEV void chain_columns(ContactRows &rows, const Shared &shared, const Mat3 &frame, Vec3 point, int link, int start,
                       float sign) {
  if (link < 0) return;
  const int depth = DEPTH[link];
#pragma unroll
  for (int k = 0; k < CHAIN; k++) {
    if (k <= depth) {
      const Motion unit = motion_of(shared, column_dof(rows, start + k));
      const Vec3 moved = sign * (frame * (unit.shift + cross(unit.turn, point)));
      rows.jacobian[0][start + k] = moved.x;
      rows.jacobian[1][start + k] = moved.y;
      rows.jacobian[2][start + k] = moved.z;
    }
  }
}

// The contact of the lane, if it has one. `velocity` is by degree of freedom.
DEV ContactRows contact_rows(const Args &args, int world, const Shared &shared, const Mat3 &object, Vec3 place,
                             int contacts, const float *velocity, const Lane &lane) {
  ContactRows rows;
  rows.here = lane.index < contacts;
  rows.first = rows.second = rows.finger = -1;
  rows.first_dof = rows.other_dof = 0;
  rows.weight = rows.slide_weight = 0;
  rows.mu = rows.friction = 1;
  rows.miss = rows.normal = {0, 0, 0};
#pragma unroll
  for (int row = 0; row < 3; row++)
#pragma unroll
    for (int column = 0; column < COLUMNS; column++) rows.jacobian[row][column] = 0;
  if (!rows.here) return rows;

  const Contact &contact = shared.contact[lane.index];
  const Pair pair = PAIR[contact.pair];
  rows.first = pair.first, rows.second = pair.second, rows.finger = pair.finger;
  if (rows.first >= 0) rows.first_dof = BLOCK_FIRST[rows.first];
  if (rows.second >= 0) rows.other_dof = rows.second == HINGES ? HINGES : BLOCK_FIRST[rows.second];
  // Friction is the same in all directions, so the tangents need not be those of the turned normal.
  rows.normal = pair.side * contact.normal;
  const Mat3 frame = contact_frame(rows.normal);
  chain_columns(rows, shared, frame, contact.point, rows.first, 0, -1);
  if (rows.second == HINGES) {
    const Vec3 arm = contact.point - place;
#pragma unroll
    for (int axis = 0; axis < 3; axis++) {
      const Vec3 turned = frame * cross(column(object, axis), arm);
      const Vec3 shifted = column(frame, axis);
      rows.jacobian[0][CHAIN + axis] = shifted.x, rows.jacobian[0][CHAIN + 3 + axis] = turned.x;
      rows.jacobian[1][CHAIN + axis] = shifted.y, rows.jacobian[1][CHAIN + 3 + axis] = turned.y;
      rows.jacobian[2][CHAIN + axis] = shifted.z, rows.jacobian[2][CHAIN + 3 + axis] = turned.z;
    }
  } else if (rows.second >= 0) {
    chain_columns(rows, shared, frame, contact.point, rows.second, CHAIN, 1);
    // A hinge that carries both links has one column: the first.
    const int both = CHAIN_MASK[rows.first < 0 ? HINGES : rows.first] & CHAIN_MASK[rows.second];
#pragma unroll
    for (int k = 0; k < CHAIN; k++)
      if (both >> column_dof(rows, CHAIN + k) & 1) {
#pragma unroll
        for (int row = 0; row < 3; row++) {
          rows.jacobian[row][k] += rows.jacobian[row][CHAIN + k];
          rows.jacobian[row][CHAIN + k] = 0;
        }
      }
  }

  float given[8];  // friction, solref [2], solimp [5]
  if (pair.row >= 0) {
    const int row = world * OBJECT_PAIRS + pair.row;
    given[0] = args.pair_friction[row];
#pragma unroll
    for (int k = 0; k < 2; k++) given[1 + k] = args.pair_solref[2 * row + k];
#pragma unroll
    for (int k = 0; k < 5; k++) given[3 + k] = args.pair_solimp[5 * row + k];
  } else {
#pragma unroll
    for (int k = 0; k < 8; k++) given[k] = HAND_SPRING[-1 - pair.row][k];
  }
  const Spring found = spring(given + 1, given + 3, contact.gap);
  rows.friction = fmaxf(given[0], 1e-15f);
  rows.mu = rows.friction * rsqrtf(IMPRATIO);
  rows.weight = found.impedance / fmaxf(pair.compliance * (1 - found.impedance), 1e-15f);
  rows.slide_weight = rows.weight * IMPRATIO;
  // miss = J a - wanted, of which this is the second part: wanted = -damping (J v) - stiffness impedance gap
  rows.miss = found.damping * times(rows, velocity);
  rows.miss.x += found.stiffness * found.impedance * contact.gap;
  return rows;
}

// The limit of the lane's hinge: presses where side * acceleration < wanted.
struct LimitRow {
  float side, wanted, weight;
};

DEV LimitRow limit_row(const State &state, const Lane &lane) {
  LimitRow row = {0, 0, 0};
  if (!lane.hinge) return row;
  const int l = lane.index;
  const float below = state.angle - LIMIT_LOW[l], above = LIMIT_HIGH[l] - state.angle, gap = fminf(below, above);
  if (gap >= 0) return row;
  float given[7];
#pragma unroll
  for (int k = 0; k < 7; k++) given[k] = LIMIT_SPRING[k][l];
  const Spring found = spring(given, given + 2, gap);
  row.side = below < above ? 1.f : -1.f;
  row.wanted = -found.damping * row.side * state.speed - found.stiffness * found.impedance * gap;
  row.weight = found.impedance / fmaxf(LIMIT_COMPLIANCE[l] * (1 - found.impedance), 1e-15f);
  return row;
}

// Coupled joints. Their rows are active always and have no friction, so that their cost is a quadratic function like
// that of inertia: they are added to the mass matrix and to the force once, and the solver knows nothing of them.
DEV void add_couplings(const State &state, Shared &shared, float &force, const Lane &lane) {
  float *mass = mass_rows(shared);
#pragma unroll 1
  for (int k = 0; k < COUPLINGS; k++) {
    const Coupling &row = COUPLING[k];
    const int other = row.second < 0 ? row.first : row.second;
    const float *c = row.polynomial;
    const float x = row.second < 0 ? 0 : from_lane(state.angle, other) - row.zero[1];
    const float slope = row.second < 0 ? 0 : c[1] + x * (2 * c[2] + x * (3 * c[3] + x * 4 * c[4]));
    const float follows = c[0] + x * (c[1] + x * (c[2] + x * (c[3] + x * c[4])));
    const float gap = from_lane(state.angle, row.first) - row.zero[0] - follows;
    const float speed = from_lane(state.speed, row.first) - slope * from_lane(state.speed, other);
    const Spring found = spring(row.spring, row.spring + 2, gap);
    const float weight = found.impedance / fmaxf(row.compliance * (1 - found.impedance), 1e-15f);
    const float wanted = -found.damping * speed - found.stiffness * found.impedance * gap;
    // J = 1 at the first hinge, -slope at the second: M + weight J^T J, force + weight J^T wanted.
    if (lane.index == row.first) {
      mass[row.first * MASS_STRIDE + row.first] += weight;
      if (row.second >= 0) mass[row.first * MASS_STRIDE + row.second] -= weight * slope;
      force += weight * wanted;
    } else if (lane.index == row.second) {
      mass[row.second * MASS_STRIDE + row.second] += weight * slope * slope;
      mass[row.second * MASS_STRIDE + row.first] -= weight * slope;
      force -= weight * slope * wanted;
    }
  }
  __syncwarp();
}
