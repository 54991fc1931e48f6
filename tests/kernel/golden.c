/* Prints one line per case: the name, the hash over all bits of all results, and the counts. */
#include <stdio.h>

#include "golden_cases.h"

int main(void) {
  for (int c = 0; c < golden_count; ++c) {
    golden_result r;
    golden_run(c, &r);
    printf("%s %016llx %u %u %u %u %u %u %u %d %d %d\n", golden_name(c), (unsigned long long)r.hash, r.count[0],
           r.count[1], r.count[2], r.count[3], r.count[4], r.flags, r.relaxed, r.iterations, r.rows, r.active);
  }
  return 0;
}
