"""Bytes that a program communicates, counted by hand. Programs for CPU devices: `learner/test_sharding.py`."""

import pytest
from collectives import received

# As XLA writes them for GPUs: asynchronous, combined, in loops whose bodies call others.
TEXT = """HloModule jit_step, is_scheduled=true, replica_count=1, num_partitions=4

%add (x: f32[], y: f32[]) -> f32[] {
  ROOT %s = f32[] add(%x, %y)
}

%inner (p: (s32[], f32[8])) -> (s32[], f32[8]) {
  %g = f32[10,2]{1,0} all-reduce-start(%x), replica_groups={{0,1,2,3}}, to_apply=%add
  %h = f32[10,2]{1,0} all-reduce-done(%g)
}

%outer (p: (s32[], f32[8])) -> (s32[], f32[8]) {
  %w = (s32[], f32[8]) while(%p), condition=%c, body=%inner, backend_config={"known_trip_count":{"n":"3"}}
  %r = bf16[4]{0} reduce-scatter(%y), replica_groups=[1,4]<=[4], dimensions={0}, to_apply=%add
}

ENTRY %main (a: f32[8]) -> f32[8] {
  %v = (s32[], f32[8]) while(%t), condition=%c, body=%outer, backend_config={"known_trip_count":{"n":"5"}}
  %b = ((f32[2], f32[1]), (f32[8], f32[4])) all-gather-start(%q, %r), replica_groups=[2,2]<=[4], dimensions={0}
  %d = (f32[6], f32[6], u32[], u32[]) collective-permute-start(%z), source_target_pairs={{0,1}}
}
"""


def test_loops_groups_and_asynchronous_forms_are_counted():
    total, counts = received(TEXT)
    assert counts == {"all-reduce": 15, "reduce-scatter": 5, "all-gather": 1, "collective-permute": 1}
    all_reduce, scatter, gather, permute = 15 * 80 * 2 * 3 / 4, 5 * 8 * 3, 48 / 2, 24
    assert total == pytest.approx(all_reduce + scatter + gather + permute)
