/* Prints one line a case: its name, the hash over every bit of every answer, and what was seen. */
#include <stdio.h>

#include "cases.h"

int main(void) {
  for (int c = 0; c < golden_count; ++c) {
    golden_result r;
    golden_run(c, &r);
    printf("%s %016llx %u %u %u %u %u %u %u %d %d %d\n", golden_name(c), (unsigned long long)r.hash, r.count[0],
           r.count[1], r.count[2], r.count[3], r.count[4], r.flags, r.relaxed, r.iterations, r.rows, r.active);
  }
  return 0;
}
