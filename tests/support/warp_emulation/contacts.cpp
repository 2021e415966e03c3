// The search for contacts of one scene as a shared library, for given poses of links [N, HINGES + 1, 12] and objects
// [N, 12]: rotation by rows, place.
#include "warp_emulation.h"

#include "scene_text.h"
#include "contacts/find.cuh"

static const Args *arguments;
static const float *links, *objects;
static int *counts, world;
static Shared memory;

static Mat3 rotation(const float *from) { return {load3(from), load3(from + 3), load3(from + 6)}; }

extern "C" void find(const Args *args, const float *poses, const float *places, Contact *contacts, int *count) {
  arguments = args, links = poses, objects = places, counts = count;
  for (world = 0; world < args->n; world++) {
    memset((void *)&memory, 0xff, sizeof memory);  // NaN: what was not written must not be read
    for (int link = 0; link <= HINGES; link++) {
      const float *from = links + (world * (HINGES + 1) + link) * 12;
      memory.pose[link].rotation = rotation(from);
      memory.pose[link].place = load3(from + 9);
    }
    run_warp([](int lane) {
      const float *from = objects + world * 12;
      const int found = find_contacts(*arguments, world, memory, rotation(from), load3(from + 9), lane);
      if (lane == 0) counts[world] = found;
    });
    memcpy(contacts + world * MAX_CONTACTS, memory.contact, sizeof memory.contact);
  }
}
