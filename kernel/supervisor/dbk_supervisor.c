/* State machine of the supervisor; see dbk_supervisor.h. */
#include "dbk/dbk_supervisor.h"

#define NEVER UINT64_MAX

static const dbk_decision no_decision = {DBK_ACTION_NONE, DBK_NO_CHECK, 0, 0};

void dbk_supervisor_init(dbk_supervisor *s) {
  for (uint32_t i = 0; i < DBK_N_CHECKS; ++i) {
    s->active_since[i] = s->gone_since[i] = NEVER;
    s->tripped[i] = 0;
  }
  s->started = s->reset_held = 0;
  s->now_us = s->time_us = s->pressed = 0;
  s->decision = no_decision;
}

/* advances the internal time by at most DBK_MAX_STEP_US and never backward */
static void advance_time(dbk_supervisor *s, uint64_t now_us) {
  if (s->started && now_us > s->now_us) {
    const uint64_t step = now_us - s->now_us;
    s->time_us += step < DBK_MAX_STEP_US ? step : DBK_MAX_STEP_US;
  }
  s->started = 1;
  s->now_us = now_us;
}

static void update_check(dbk_supervisor *s, uint32_t i, int active) {
  const dbk_check *check = &dbk_checks[i];
  if (active) {
    if (s->active_since[i] == NEVER) { s->active_since[i] = s->time_us; }
    s->gone_since[i] = NEVER;
    if (s->time_us - s->active_since[i] >= check->after_us) { s->tripped[i] = 1; }
    return;
  }
  if (s->gone_since[i] == NEVER) { s->gone_since[i] = s->time_us; }
  if (s->time_us - s->gone_since[i] >= check->release_us) {
    s->active_since[i] = NEVER;
    if (check->clears == DBK_WHEN_GONE) { s->tripped[i] = 0; }
  }
}

/* clears the latched checks if none of their conditions is present; the robot then holds until a person resumes */
static int reset_latched(dbk_supervisor *s, uint64_t conditions) {
  uint64_t watched = 0;
  int latched = 0;
  for (uint32_t i = 0; i < DBK_N_CHECKS; ++i) {
    if (s->tripped[i] && dbk_checks[i].clears == DBK_ON_TWO_STEP_RESET) {
      watched |= dbk_checks[i].condition;
      latched = 1;
    }
  }
  if (!latched || (conditions & watched)) { return 0; }
  for (uint32_t i = 0; i < DBK_N_CHECKS; ++i) {
    if (dbk_checks[i].clears == DBK_ON_TWO_STEP_RESET) { s->tripped[i] = 0; }
  }
  s->reset_held = 1;
  return 1;
}

/* applies buttons in the update in which they are pressed */
static void apply_buttons(dbk_supervisor *s, uint64_t pressed, uint64_t conditions) {
  if (!((pressed & DBK_CONDITION_RESET) && reset_latched(s, conditions)) && (pressed & DBK_CONDITION_RESUME)) {
    s->reset_held = 0;
  }
  if (pressed & (DBK_CONDITION_RESUME | DBK_CONDITION_CONTINUE)) {
    for (uint32_t i = 0; i < DBK_N_CHECKS; ++i) {
      if (dbk_checks[i].clears == DBK_ON_CONTINUE && s->active_since[i] == NEVER) { s->tripped[i] = 0; }
    }
  }
}

static dbk_decision decide(const dbk_supervisor *s) {
  dbk_decision decision = no_decision;
  for (uint32_t i = 0; i < DBK_N_CHECKS; ++i) {
    if (s->tripped[i]) {
      decision.action = dbk_checks[i].action;
      decision.check = (uint8_t)i;
      decision.immediate_drive_off = dbk_checks[i].immediate_drive_off;
      decision.ends_contract = (uint8_t)(decision.ends_contract | dbk_checks[i].ends_contract);
    }
  }
  if (s->reset_held && decision.action < DBK_ACTION_HOLD) {
    decision.action = DBK_ACTION_HOLD;
    decision.check = DBK_RESET_HELD;
    decision.immediate_drive_off = 0;
  }
  return decision;
}

dbk_decision dbk_supervisor_update(dbk_supervisor *s, uint64_t now_us, uint64_t conditions) {
  advance_time(s, now_us);
  const uint64_t pressed = conditions & ~s->pressed & DBK_CONDITION_BUTTONS;
  s->pressed = conditions & DBK_CONDITION_BUTTONS;
  for (uint32_t i = 0; i < DBK_N_CHECKS; ++i) { update_check(s, i, (conditions & dbk_checks[i].condition) != 0); }
  if (pressed) { apply_buttons(s, pressed, conditions); }
  s->decision = decide(s);
  return s->decision;
}
