// The contacts of a world.
#pragma once
#include "contacts/balls.cuh"
#include "contacts/box_box.cuh"
#include "contacts/capsules.cuh"
#include "contacts/planes.cuh"

// Finds what touches and writes it to `shared.contact`, in the same order every time. Returns how many contacts there
// are, on all lanes alike: more than MAX_CONTACTS where there are too many even to choose the deepest.
DEV int find_contacts(const Args &args, int world, Shared &shared, const Mat3 &object_rotation, Vec3 object_place,
                      int lane) {
  const Search search = {args, shared, *(Found *)scratch(shared), world, lane};
  place_primitives(search, object_rotation, object_place);
  int count = 0;
  if (SPHERES + CAPSULES) count = balls_meet(search, count);
  if (ROUND_PAIRS) count = capsules_meet(search, count);
  if (PLANE_POINTS) count = planes_meet(search, count);
  if (BOXES * BOX_PRIMITIVES) count = boxes_meet(search, count);
  __syncwarp();
  return EXTRA_CONTACTS && count > MAX_CONTACTS ? keep_deepest(search, count) : count;
}
