#include "presence.h"

#include <fcntl.h>
#include <inttypes.h>
#include <limits.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/file.h>
#include <sys/stat.h>
#include <time.h>
#include <unistd.h>

#include "clock.h"

static void path_of(char path[PATH_MAX], const char *serial, const char *ending, bool make) {
    const char *folder = getenv("MFS_SIM_GENTL_DIR");
    char standard[PATH_MAX / 2];
    if (!folder || !*folder) {
        const char *temporary = getenv("TMPDIR");
        snprintf(standard, sizeof standard, "%s/mfs-sim-gentl-%u", temporary && *temporary ? temporary : "/tmp",
                 (unsigned)getuid());
        folder = standard;
    }
    if (make)
        mkdir(folder, 0700);
    snprintf(path, PATH_MAX, "%s/%s.%s", folder, serial, ending);
}

bool presence_plugged(const char *serial) {
    char path[PATH_MAX];
    path_of(path, serial, "unplugged", false);
    FILE *file = fopen(path, "re");
    if (!file)
        return true;
    int64_t back = 0;
    bool returns = fscanf(file, "%" SCNd64, &back) == 1 && back > 0;
    fclose(file);
    if (!returns || clock_now() < back)
        return false;
    unlink(path);
    return true;
}

void presence_unplug(const char *serial, int64_t back_ns) {
    char path[PATH_MAX], draft[PATH_MAX];
    path_of(path, serial, "unplugged", true);
    path_of(draft, serial, "unplugging", true);
    FILE *file = fopen(draft, "we");
    if (!file)
        return;
    fprintf(file, "%" PRId64 "\n", back_ns);
    fclose(file);
    rename(draft, path);
}

static int open_and_lock(const char *serial, int operation) {
    char path[PATH_MAX];
    path_of(path, serial, "lock", true);
    int lock = open(path, O_CREAT | O_RDWR | O_CLOEXEC, 0600);
    if (lock >= 0 && flock(lock, operation | LOCK_NB) != 0) {
        close(lock);
        return -1;
    }
    return lock;
}

int presence_claim(const char *serial) {
    int lock = open_and_lock(serial, LOCK_EX);
    /* presence_claimed() in another process holds the lock for an instant. */
    for (int attempt = 0; lock < 0 && attempt < 5; attempt++) {
        nanosleep(&(struct timespec){0, 2000000}, NULL);
        lock = open_and_lock(serial, LOCK_EX);
    }
    return lock;
}

void presence_release(int lock) { close(lock); }

bool presence_claimed(const char *serial) {
    int lock = open_and_lock(serial, LOCK_SH);
    if (lock < 0)
        return true;
    close(lock);
    return false;
}
