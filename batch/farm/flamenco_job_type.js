// SPDX-License-Identifier: GPL-3.0-or-later
//
// Job type of PhysGen for Flamenco 3: lay this file into the folder "scripts" beside flamenco-manager.
// `physgen batch JOBS.toml --export flamenco` writes it together with a job of it.
//
// A task runs one task of a plan file, which lies in the folder that the workers share. All is handed over as lists of
// arguments; nothing goes through a shell.

const JOB_TYPE = {
    label: "PhysGen batch",
    description: "Photo to simulated video: the tasks of a PhysGen job file",
    settings: [
        { key: "plan", type: "string", subtype: "file_path", required: true, visible: "web",
          description: "Plan file, below the folder that all workers see" },
        { key: "python", type: "string", required: true, visible: "web",
          description: "Python interpreter with PhysGen; a variable of Flamenco where it differs from worker to worker" },
        { key: "retries", type: "int32", default: 0, visible: "web",
          description: "How often a worker starts a task again by itself; Flamenco then tries other workers" },
        { key: "tasks", type: "string", required: true, visible: "hidden",
          description: "JSON list of [name, task type, numbers of the tasks that it needs]" },
    ],
};

function compileJob(job) {
    const settings = job.settings;
    const authored = [];
    for (const [name, type, needs] of JSON.parse(settings.tasks)) {
        const task = author.Task(name, type);
        task.addCommand(author.Command("exec", {
            exe: settings.python,
            args: [
                // Not from the working folder: a job may come from anybody.
                "-P", "-m", "physgen.batch.farm.run_task", settings.plan, name,
                "--retries", String(settings.retries || 0),
            ],
        }));
        for (const number of needs) {
            task.addDependency(authored[number]);
        }
        authored.push(task);
    }
    for (const task of authored) {
        job.addTask(task);
    }
}
