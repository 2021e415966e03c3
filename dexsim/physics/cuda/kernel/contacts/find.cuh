// The contacts of a world.
#pragma once
#include "contacts/balls.cuh"
#include "contacts/box_box.cuh"
#include "contacts/capsules.cuh"
#include "contacts/planes.cuh"

// Finds what touches and writes it to `shared.contact`, in the same order every time. Returns how many there are, on
// all lanes alike; only the first MAX_CONTACTS of them are written.
DEV int find_contacts(const Args &args, int world, Shared &shared, const Mat3 &object_rotation, Vec3 object_place,
                      int lane) {
  static_assert(PRIMITIVES * sizeof(Solid) + sizeof(BoxPair) <= SCRATCH * sizeof(float), "the primitives fit");
  Solid *const primitives = (Solid *)scratch(shared);
  place_primitives(args, world, object_rotation, object_place, lane, primitives);
  const Search search = {args, shared, primitives, world, lane};
  int count = 0;
  if (SPHERES + CAPSULES) count = balls_meet(search, count);
  if (ROUND_PAIRS) count = capsules_meet(search, count);
  if (PLANE_POINTS) count = planes_meet(search, count);
  if (BOXES * BOX_PRIMITIVES) count = boxes_meet(search, count);
  __syncwarp();
  return count;
}
