/* The agent: creates both segments, asks, removes both names. */

proctype Agent(byte me) {
    mtype state = ABSENT, what, kind, lie;
    byte found = NONE, server = NONE, number, steps, due, rung, first, second, begin, step, end_;
  {
    skip;
create:
    if
    :: atomic { cmd_name == NONE -> cmd_name = me }
    :: atomic { cmd_name != NONE -> found = cmd_name; has[me] = found };
        if                            /* without an owner: unfinished, and that for longer than its grace */
        :: cmd[found].owner == NONE || !alive[cmd[found].owner] -> remove_dead(found)
        :: else -> goto out           /* a living agent's */
        fi;
        if
        :: cmd_name != found -> d_step { let_go(me, found); found = NONE }; goto create
        :: else -> goto out           /* its lock is held */
        fi
    fi;
    if
    :: atomic { cmd[me].lock == NONE -> cmd[me].lock = me }
    :: else -> goto out               /* taken for a dead one's, and about to be removed */
    fi;
#ifndef FAULT_NO_SECOND_LOOK
    if
    :: cmd_name == me
    :: else -> goto out               /* removed before it was locked */
    fi;
#endif
    atomic { assert(pose_name == NONE); pose_name = me };
    cmd[me].owner = me;
#ifndef FAULT_MAGIC_FIRST
    cmd[me].session = me;
    cmd[me].magic = true;
#else
    cmd[me].magic = true;
    cmd[me].session = me;
#endif
    atomic { what = OFFER; offered() };
#ifdef ROGUE
    if
    :: LIAR -> cmd[me].bell = 1; goto await_end
    :: true
    fi;
#endif
    do
    :: atomic { pose[me].magic -> server = pose[me].owner; assert(pose[me].session == me); break }
    :: atomic { pose[me].farewell -> SAID_WHY(pose[me]); goto leave_broken }
    :: atomic { told[me] -> what = FAREWELL; goto leave_broken }
    :: atomic { what = LOSS; goto leave_broken } /* its deadline, or its launcher's word that the child ended */
    od;
    if
    :: atomic { pose[me].bell == 0 -> what = ATTACH; attached() }
    :: atomic { else -> what = VIOLATION; goto leave_broken }
    fi;

ready:
    atomic {
        assert(cmd_name == me && pose_name == me);
        if
        :: told[me] -> what = FAREWELL; goto leave_broken
        :: pose[me].bell != number -> what = VIOLATION; goto leave_broken
        :: else
        fi;
        if
        :: number == REQUESTS -> what = GOODBYE
        :: number < REQUESTS -> what = STEP
#ifdef ANY_REQUEST
        :: number < REQUESTS -> what = GOODBYE
        :: number < REQUESTS -> what = RESET
        :: number < REQUESTS -> what = REGISTER_TUBE
        :: number < REQUESTS -> what = RELEASE_TUBE
#endif
        fi;
        perhaps_lie(TOO_SOON);
        due = steps + (what == STEP -> 1 : 0);
        number++;
        asked();
        assert(pose[me].bell == cmd[me].bell && cmd[me].lock == me || LIAR) /* our turn, and ours to write */
    };
    if
    :: what == GOODBYE -> remove_names(me)
    :: else
    fi;
    publish(cmd[me], number, what, due);
#ifdef ROGUE
    if
    :: lie == TOO_SOON -> cmd[me].begin = number + 1; cmd[me].bell = number + 1
    :: else
    fi;
#endif
    atomic { forget(); waits[me] = true };
    do
    :: pose[me].bell != number - 1 -> goto rang
    :: atomic { pose[me].farewell -> SAID_WHY(pose[me]); break }
#ifndef FAULT_NO_LIVENESS
    :: atomic { !alive[server] -> what = LOSS; break }
#endif
    :: atomic { told[me] -> what = FAREWELL; goto leave_broken }
    od;
#ifndef FAULT_NO_LAST_LOOK
    if
    :: pose[me].bell != number - 1    /* it rang before it ended */
    :: else -> goto leave_broken
    fi;
#else
    goto leave_broken;
#endif
rang:
    take(pose[me]);
    atomic {
        waits[me] = false;
        if
        :: rung == number && begin == number && end_ == number &&
                (kind == DONE && step == due || kind == REFUSED && step == steps) ->
            assert(lie == 0 || lie == TOO_SOON);
            assert(first == second && (first == number) == (kind == DONE))
        :: else -> what = VIOLATION; goto leave_broken
        fi;
        steps = step;
        what = kind;
        answered();
        forget();
        if
        :: state == CLOSED -> assert(steps == integrated[me]); goto out
        :: state == READY && lie == 0 -> goto ready
        :: state == READY && lie != 0 -> goto await_end
        fi
    };
await_end:                            /* the liar's own part is over: the other side must end the session */
    do
    :: atomic { pose[me].farewell -> what = FAREWELL; break }
    :: atomic { !alive[AGENTS] -> what = LOSS; break }
    od;
leave_broken:
    atomic {
        assert(PEER_LIES || what != VIOLATION);
        assert(steps <= integrated[me] && integrated[me] <= steps + 1);
        assert(what != LOSS || number == 0 || pose[me].bell != number || PEER_LIES || LIAR); /* its last word counted */
        waits[me] = false;
        broken();
        forget()
    };
    remove_names(me);
    say_farewell(cmd[me]);
out:
    gone(me, found)
  } unless {
    d_step { !alive[me] -> forget(); state = 0; lie = 0; found = 0; server = 0; number = 0; steps = 0; due = 0 }
  }
}
